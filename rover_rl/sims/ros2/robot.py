"""ROS 2 node of a simulated rover, with the topics of the original's rover in Gazebo.

It replaces a real rover or Gazebo in tests and first trials. Every ROS 2 tool can use it.
"""

from __future__ import annotations

import logging
import math
import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Any

import numpy as np
from torch import Tensor

from rover_rl.sims.ros2 import messages as ros
from rover_rl.sims.ros2.frames import BASE, IMU, LIDAR, ODOM, WORLD, RobotFrames, info_topic
from rover_rl.sims.ros2.ground import elevation_map_message, point_cloud_message
from rover_rl.sims.ros2.images import image_format
from rover_rl.sims.ros2.poses import heading, read_finite, read_pose, yaw_of
from rover_rl.sims.ros2.settings import Ros2Settings
from rover_rl.sims.ros2.transport import ThrottledLogger, Transport, other_types, short
from rover_rl.sims.rover_state import RoverState
from rover_rl.sims.sensor_report import SensorReport, SimulatedRover, Variances
from rover_rl.sims.settings import Connection

TYPES_PERIOD = 1.0  # time between two looks at the types of the messages that others send, s
COMMAND_LIFETIME = 0.5  # simulation time without a command after which the rover stops, as real rovers do, s
RANGE_MIN = 0.15  # minimum range of the original's lidar, m
NOT_MEASURED = -1.0  # first entry of a covariance that marks a quantity as not measured (sensor_msgs/Imu)
UNKNOWN = 1e6  # variance of the numbers of a message that are 0 because nothing measures them
EXACT = 1e-6  # least variance: a covariance of zeros would mean that it is unknown (sensor_msgs/Imu)

_log = logging.getLogger(__name__)


class RobotNode:
    """ROS 2 node of a simulated rover: publishes scan, IMU, odometry, poses, tf, clock and images; receives commands.

    It starts at x, y (m) and yaw (rad). Scans cover the angle ``view`` (rad), half of it to either side of straight
    ahead. ``is_localized`` is that of :class:`RobotFrames`, and ``world_map`` a ``nav_msgs/OccupancyGrid`` to publish.
    """

    def __init__(
        self,
        rover: SimulatedRover,
        transport: Transport,
        lidar_range: float,
        settings: Ros2Settings = Ros2Settings(),  # noqa: B008  (it is frozen)
        connection: Connection = Connection(),  # noqa: B008
        start: tuple[float, float, float] = (0.0, 0.0, 0.0),
        view: float = 2 * math.pi,
        is_localized: bool = True,
        world_map: Any = None,
    ) -> None:
        self._rover, self._transport, self._settings, self._connection = rover, transport, settings, connection
        self._lidar_range, self._view = lidar_range, view
        # Forward speed (m/s) and yaw rate (rad/s), and the time since they arrived: replaced by the transport's thread.
        self._command: list[Any] = [(0.0, 0.0), 0.0]
        self._reset_poses = deque[Any](maxlen=1)  # messages
        self._yaw = start[2]
        self._frames = RobotFrames(rover.robot, rover.devices, settings.lidar_yaw, is_localized)
        self._odometry = (0.0, 0.0, 0.0)  # pose relative to the start: the integral of the wheels' velocities
        self._spread = np.zeros((4, 4))  # covariance of that pose and of the scale factor of the velocities
        self._publishers: dict[str, Callable[[Any], None]] = {}
        self._types_checked = -math.inf
        self._log = ThrottledLogger(_log)
        rover.reset(start)
        command = ros.TwistStamped if settings.command == "twist_stamped" else ros.Twist
        self._receives = {connection.cmd_vel_topic: command, settings.reset_topic: ros.PoseStamped}
        transport.subscribe(connection.cmd_vel_topic, command, self._receive_command)
        # Reliable, as a reset pose is sent only once.
        transport.subscribe(settings.reset_topic, ros.PoseStamped, self._reset_poses.append, reliable=True)
        self._publish(settings.tf_static_topic, self._frames.fixed(), latched=True)
        self._publish(settings.description_topic, self._frames.description(), latched=True)
        if world_map is not None:
            self._publish(settings.map_topic, world_map, latched=True)

    def run(self, rate: float, stop: threading.Event) -> None:
        """Steps the rover until ``stop`` is set, at ``rate`` times real time."""
        due = time.monotonic()
        while not stop.is_set():
            dt = self.step()
            due = max(due + dt / rate, time.monotonic() - dt / rate)  # does not catch up after a delay
            stop.wait(max(0.0, due - time.monotonic()))

    def step(self) -> float:
        """Runs one control step with the latest command, publishes the state, and returns the step's duration, s."""
        self._check_types()
        if self._reset_poses:
            self._move_to(self._reset_poses.pop())
        latest = self._command
        command = latest[0] if latest[1] < COMMAND_LIFETIME else (0.0, 0.0)
        latest[1] += self._rover.control_dt
        self._publish_report(self._rover.step(command))
        return self._rover.control_dt

    def _receive_command(self, msg: Any) -> None:
        twist = getattr(msg, "twist", msg)
        linear, angular = twist.linear, twist.angular
        speed, *others, yaw_rate = numbers = (linear.x, linear.y, linear.z, angular.x, angular.y, angular.z)
        read_finite("command", *numbers)
        if any(others):
            text = "%s: only linear.x and angular.z move the robot, and the rest of a command is ignored"
            self._log.warning("others", text, self._connection.cmd_vel_topic)
        self._command = [(speed, yaw_rate), 0.0]

    def _move_to(self, msg: Any) -> None:
        try:
            if (frame := msg.header.frame_id) not in ("", WORLD):
                raise ValueError(f"its frame_id must be {WORLD!r}, the frame of the world, or empty, got {frame!r}")
            position, orientation, _ = read_pose(msg.pose)
            x, y, _ = position.tolist()
            yaw = yaw_of(orientation)
            self._rover.move_to((x, y, yaw))
        except ValueError as error:
            text = "%s: ignored a pose, and the rover stays where it is: %s"
            self._log.warning(str(error), text, self._settings.reset_topic, error)
            return
        self._yaw = yaw
        self._command = [(0.0, 0.0), 0.0]  # a reset discards earlier commands

    def _check_types(self) -> None:
        if time.monotonic() < self._types_checked + TYPES_PERIOD:
            return
        self._types_checked = time.monotonic()
        for topic, kind in self._receives.items():
            if others := other_types(self._transport, topic, kind):
                hint = "; with --command twist_stamped, it receives TwistStamped" if kind is ros.Twist else ""
                text = "%s: ignored %s: the robot receives %s%s"
                self._log.warning(topic, text, topic, others, short(kind.ros_type), hint)

    def _publish_report(self, report: SensorReport) -> None:
        state, settings, connection, frames = report.state, self._settings, self._connection, self._frames
        stamp, scan_time = (ros.Time.from_seconds(time) for time in (state.stamp.item(), report.scan_stamp))
        orientation = ros.Quaternion(*state.orientation[0].tolist())
        pose = ros.Pose(ros.Point(*state.position[0].tolist()), orientation)
        for kind, images in report.images.items():
            for own, image in images.items():
                topic, frame = own or connection.image_topics[kind], frames.frame_of(kind, own)
                self._publish(topic, image_format(kind, topic).write(image, scan_time, frame))
                self._publish(info_topic(topic), frames.camera_info(kind, own, scan_time))
        for own, points in report.points.items():
            cloud = point_cloud_message(points, scan_time, frames.frame_of("points", own))
            self._publish(own or connection.points_topic, cloud)
        for own, ground in report.ground.items():
            self._publish(own or connection.elevation_topic, elevation_map_message(ground, stamp, WORLD))
        self._publish(settings.clock_topic, ros.Clock(ros.Time.from_seconds(report.time)))
        self._publish(settings.pose_topic, ros.PoseArray(ros.Header(stamp, WORLD), [pose]))
        self._publish(connection.imu_topic, self._imu(state, stamp, orientation, report.variances))
        odometry = self._wheel_odometry(state, stamp, report.variances)
        self._publish(settings.odometry_topic, odometry)
        if (moving := frames.moving(stamp, pose, odometry.pose.pose)) is not None:
            self._publish(settings.tf_topic, moving)
        if report.ranges is not None:  # last, as subscribers wait for it
            self._publish(connection.scan_topic, self._scan(report.ranges, scan_time))

    def _publish(self, topic: str, message: Any, latched: bool = False) -> None:
        if topic not in self._publishers:
            # Reliable publishers match every subscription, including those of RViz and of ROS's default profile.
            self._publishers[topic] = self._transport.publisher(topic, type(message), reliable=True, latched=latched)
        self._publishers[topic](message)

    def _wheel_odometry(self, state: RoverState, stamp: Any, variances: Variances) -> Any:
        speed, yaw_rate, dt = state.linear_velocity.item(), state.angular_velocity.item(), state.dt.item()
        x, y, yaw = self._odometry
        middle = yaw + yaw_rate * dt / 2
        x, y, yaw = x + speed * dt * math.cos(middle), y + speed * dt * math.sin(middle), yaw + yaw_rate * dt
        self._odometry = (x, y, yaw)
        self._spread[3, 3] = variances.scale
        self._spread = _propagated(self._spread, speed * dt, yaw_rate * dt, middle, variances.noise)
        place = np.diag([EXACT, EXACT, UNKNOWN, UNKNOWN, UNKNOWN, EXACT])
        place[np.ix_([0, 1, 5], [0, 1, 5])] += self._spread[:3, :3]
        relative = variances.noise + variances.scale
        along, turn = (EXACT + relative * each * each for each in (speed, yaw_rate))
        pose = ros.PoseWithCovariance(ros.Pose(ros.Point(x, y), ros.Quaternion(*heading(yaw))), place.ravel())
        twist = ros.Twist(ros.Vector3(x=speed), ros.Vector3(z=yaw_rate))
        spread = np.diag([along, EXACT, UNKNOWN, UNKNOWN, UNKNOWN, turn]).ravel()
        return ros.Odometry(ros.Header(stamp, ODOM), BASE, pose, ros.TwistWithCovariance(twist, spread))

    def _imu(self, state: RoverState, stamp: Any, orientation: Any, variances: Variances) -> Any:
        # The body turns more slowly than wheel odometry reports.
        yaw = yaw_of(state.orientation[0])
        yaw_rate, self._yaw = math.remainder(yaw - self._yaw, 2 * math.pi) / state.dt.item(), yaw
        imu = ros.Imu(ros.Header(stamp, IMU), orientation, angular_velocity=ros.Vector3(z=yaw_rate))
        tilt, yaw_variance, turn = (EXACT + each for each in variances[:3])
        imu.orientation_covariance = np.diag([tilt, tilt, yaw_variance]).ravel()
        imu.angular_velocity_covariance = np.diag([UNKNOWN, UNKNOWN, turn]).ravel()
        imu.linear_acceleration_covariance[0] = NOT_MEASURED
        return imu

    def _scan(self, ranges: Tensor, stamp: Any) -> Any:
        """Builds a scan message according to REP 117, with the lidar's zero angle in direction ``lidar_yaw``.

        A full turn begins straight ahead; a narrower view begins at its right edge.
        """
        increment = 2 * math.pi / len(ranges)
        first, count = 0, len(ranges)
        if self._view < 2 * math.pi:
            half = int(self._view / 2 / increment)
            first, count = -half, 2 * half + 1
        readings = ranges.roll(-first)[:count].numpy().astype(np.float32)
        readings[readings > self._lidar_range] = np.inf
        readings[readings < RANGE_MIN] = -np.inf
        angle_min = first * increment - self._settings.lidar_yaw
        return ros.LaserScan(
            ros.Header(stamp, LIDAR),
            angle_min=angle_min,
            angle_max=angle_min + (count - 1) * increment,
            angle_increment=increment,
            scan_time=self._rover.control_dt,
            range_min=RANGE_MIN,
            range_max=self._lidar_range,
            ranges=readings,
        )


def _propagated(spread: np.ndarray, way: float, turn: float, yaw: float, noise: float) -> np.ndarray:
    """Returns the covariance of a dead reckoning after a step, ``[4, 4]``: of x, y, yaw and the scale of velocities.

    Linearized (S. Thrun, W. Burgard, D. Fox, *Probabilistic Robotics*, 2005, section 7.2), for a ``way`` (m) along
    ``yaw`` and a ``turn`` (rad), each with an error of relative variance ``noise``.
    """
    ahead, left = np.array([math.cos(yaw), math.sin(yaw)]), np.array([-math.sin(yaw), math.cos(yaw)])
    change, drawn = np.eye(4), np.zeros((4, 2))
    change[:2, 2], change[:2, 3], change[2, 3] = way * left, way * ahead, turn
    drawn[:2, 0], drawn[2, 1] = way * ahead, turn
    return change @ spread @ change.T + noise * drawn @ drawn.T
