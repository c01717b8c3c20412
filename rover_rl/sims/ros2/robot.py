"""ROS 2 node of a simulated rover, with the topics of the original's rover in Gazebo, tf, its shape and a map.

It replaces a real rover or Gazebo in tests and first trials. The frames of tf, from parent to child, are::

    map -> world -> odom -> base_link -> lidar_link, imu_link, NAME_link, NAME_link -> NAME_optical_frame

``NAME`` is that of a camera or a 3D lidar. ``world`` is ``map``: the frame of the poses. Wheel odometry tells where
``base_link`` is in ``odom``, and a localizer, which errs as the robot's pose does, where ``odom`` is in ``world``.
"""

from __future__ import annotations

import logging
import math
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable
from typing import Any
from xml.sax.saxutils import quoteattr

import numpy as np
from scipy.spatial.transform import Rotation
from torch import Tensor

from rover_rl.robots import Robot
from rover_rl.robots.shapes import Frame, Shape
from rover_rl.sims.ros2 import messages as ros
from rover_rl.sims.ros2.ground import elevation_map_message, point_cloud_message
from rover_rl.sims.ros2.images import image_format
from rover_rl.sims.ros2.poses import heading, read_finite, read_pose, yaw_of
from rover_rl.sims.ros2.settings import Ros2Settings
from rover_rl.sims.ros2.tf import MAP, WORLD, Transform
from rover_rl.sims.ros2.transport import ThrottledLogger, Transport, other_types, short
from rover_rl.sims.rover_state import RoverState
from rover_rl.sims.sensor_report import Device, DeviceKind, SensorReport, SimulatedRover, Variances
from rover_rl.sims.settings import Connection
from rover_rl.worlds.clearance import clearance_on_grid
from rover_rl.worlds.world import World

ODOM, BASE, LIDAR, IMU = "odom", "base_link", "lidar_link", "imu_link"
TYPES_PERIOD = 1.0  # time between two looks at the types of the messages that others send, s
COMMAND_LIFETIME = 0.5  # simulation time without a command after which the rover stops, as real rovers do, s
RANGE_MIN = 0.15  # minimum range of the original's lidar, m
NOT_MEASURED = -1.0  # first entry of a covariance that marks a quantity as not measured (sensor_msgs/Imu)
UNKNOWN = 1e6  # variance of the numbers of a message that are 0 because nothing measures them
EXACT = 1e-6  # least variance: a covariance of zeros would mean that it is unknown (sensor_msgs/Imu)
MAP_CELL = 0.05  # side of a cell of the map, m
OCCUPIED = 100  # what an occupied cell of a ``nav_msgs/OccupancyGrid`` has; a free one has 0
OPTICAL = Rotation.from_matrix([[0, 0, 1], [-1, 0, 0], [0, -1, 0]])
"""Axes of an image in those of its camera: to the right, down and ahead (REP 103)."""
GRAY = (0.5, 0.5, 0.5)

_log = logging.getLogger(__name__)


class RobotNode:
    """ROS 2 node of a simulated rover: publishes scan, IMU, odometry, poses, tf, clock and images; receives commands.

    It starts at x, y (m) and yaw (rad). Scans cover the robot's ``lidar_view``, half of it to either side of straight
    ahead. ``is_localized`` is that of :class:`RobotFrames`, and ``world_map`` a ``nav_msgs/OccupancyGrid`` to publish.
    """

    def __init__(
        self,
        rover: SimulatedRover,
        transport: Transport,
        settings: Ros2Settings = Ros2Settings(),  # noqa: B008  (it is frozen)
        connection: Connection = Connection(),  # noqa: B008
        start: tuple[float, float, float] = (0.0, 0.0, 0.0),
        is_localized: bool = True,
        world_map: Any = None,
    ) -> None:
        self._rover, self._transport, self._settings, self._connection = rover, transport, settings, connection
        # Forward speed (m/s) and yaw rate (rad/s), and the time since they arrived: replaced by the transport's thread.
        self._command: list[Any] = [(0.0, 0.0), 0.0]
        self._reset_poses, self._yaw = deque[Any](maxlen=1), start[2]  # messages, and the last yaw (rad)
        self._frames = RobotFrames(rover.robot, rover.devices, settings.lidar_yaw, is_localized)
        self._odometry = (0.0, 0.0, 0.0)  # pose relative to the start: the integral of the wheels' velocities
        self._spread = np.zeros((4, 4))  # covariance of that pose and of the scale factor of the velocities
        self._publishers: dict[str, Callable[[Any], None]] = {}
        self._types_checked, self._log = -math.inf, ThrottledLogger(_log)
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
        numbers = [getattr(part, axis) for part in (twist.linear, twist.angular) for axis in "xyz"]
        speed, *others, yaw_rate = numbers
        read_finite("command", *numbers)
        if any(others):
            text = "%s: only linear.x and angular.z move the robot, and the rest of a command is ignored"
            self._log.warning("others", text, self._connection.cmd_vel_topic)
        self._command = [(speed, yaw_rate), 0.0]

    def _move_to(self, msg: Any) -> None:
        try:
            if (frame := msg.header.frame_id) not in ("", WORLD):
                raise ValueError(f"its frame_id must be {WORLD!r}, the frame of the world, or empty, got {frame!r}")
            pose = read_pose(msg)
            (x, y, _), yaw = pose.position.tolist(), yaw_of(pose.orientation)
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
        pose = ros.Pose(ros.Point(*state.position[0].tolist()), ros.Quaternion(*state.orientation[0].tolist()))
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
        self._publish(connection.imu_topic, self._imu(state, stamp, pose.orientation, report.variances))
        odometry = self._wheel_odometry(state, stamp, report.variances)
        self._publish(settings.odometry_topic, odometry)
        if (moving := frames.moving(stamp, pose, odometry.pose.pose)) is not None:
            self._publish(settings.tf_topic, moving)
        if report.ranges is not None:  # last, as subscribers wait for it
            self._publish(connection.scan_topic, self._scan(report.ranges, scan_time))

    def _publish(self, topic: str, message: Any, latched: bool = False) -> None:
        if topic not in self._publishers:
            # Reliable publishers match every subscription, including those of RViz and of ROS's default profile.
            self._publishers[topic] = self._transport.publisher(topic, type(message), latched=latched)
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
        """Builds a scan message (REP 117): a full turn begins straight ahead, a narrower view at its right edge."""
        robot, increment, first, count = self._rover.robot, 2 * math.pi / len(ranges), 0, len(ranges)
        if robot.lidar_view < 2 * math.pi:
            half = int(robot.lidar_view / 2 / increment)
            first, count = -half, 2 * half + 1
        readings = ranges.roll(-first)[:count].numpy().astype(np.float32)
        readings[readings > robot.lidar_range] = np.inf
        readings[readings < RANGE_MIN] = -np.inf
        low = first * increment - self._settings.lidar_yaw
        angles = (low, low + (count - 1) * increment, increment)
        rest = {"range_min": RANGE_MIN, "range_max": robot.lidar_range, "scan_time": self._rover.control_dt}
        return ros.LaserScan(ros.Header(stamp, LIDAR), *angles, **rest, ranges=readings)


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


class RobotFrames:
    """Frames of a robot, its lidar, turned by ``lidar_yaw`` (rad), its IMU and its ``devices``.

    If it ``is_localized``, they tell where ``odom`` is in ``world``. Else, another node tells where it is in ``map``.
    """

    def __init__(
        self, robot: Robot, devices: Iterable[Device] = (), lidar_yaw: float = 0.0, is_localized: bool = True
    ) -> None:
        self._robot, self._lidar_yaw, self._is_localized = robot, lidar_yaw, is_localized
        self._devices = {(device.kind, device.topic): device for device in devices}
        self._last = -math.inf

    def fixed(self) -> Any:
        """Returns the transforms that never change, a ``tf2_msgs/TFMessage``."""
        origin, straight, turned = np.zeros(3), Rotation.identity(), Rotation.from_euler("z", self._lidar_yaw)
        found = [Transform(BASE, LIDAR, np.array(self._robot.lidar_position), turned)]
        found += [Transform(BASE, IMU, np.array(self._robot.imu_position), straight)]
        for device in self._devices.values():
            link, ahead = f"{device.name}_link", Rotation.from_euler("ZY", (device.yaw, device.pitch))
            found.append(Transform(BASE, link, np.array(device.mount), ahead))
            if device.kind != "points":
                found.append(Transform(link, _frame(device), origin, OPTICAL))
        found += [Transform(MAP, WORLD, origin, straight)] if self._is_localized else []
        return ros.TFMessage([each.message(ros.Time()) for each in found])

    def moving(self, stamp: Any, pose: Any, odometry: Any) -> Any | None:
        """Returns the transforms at a stamp, or ``None`` if it is not later than the last one, as tf wants it.

        ``pose`` and ``odometry`` are where the robot is in ``world`` and ``odom``, a ``geometry_msgs/Pose`` each.
        """
        if ros.seconds_of(stamp) <= self._last:
            return None
        self._last = ros.seconds_of(stamp)
        base = Transform(ODOM, BASE, *_read(odometry))
        found = [base]
        if self._is_localized:
            # world -> base_link = world -> odom * odom -> base_link
            position, rotation = _read(pose)
            turn = rotation * base.rotation.inv()
            found.append(Transform(WORLD, ODOM, position - turn.apply(base.position), turn))
        return ros.TFMessage([each.message(stamp) for each in found])

    def frame_of(self, kind: DeviceKind, topic: str | None) -> str:
        """Returns the frame of what a camera or a 3D lidar tells, by its topic, or ``None`` for the connection's."""
        return _frame(self._devices[kind, topic])

    def camera_info(self, kind: DeviceKind, topic: str | None, stamp: Any) -> Any:
        """Returns what a camera is, a ``sensor_msgs/CameraInfo``: one without distortion."""
        camera = self._devices[kind, topic]
        (rows, columns), focal = camera.size, camera.focal_length
        matrix = np.array([[focal, 0, (columns - 1) / 2], [0, focal, (rows - 1) / 2], [0, 0, 1.0]])
        projection = np.hstack((matrix, np.zeros((3, 1)))).ravel()
        header, lens = ros.Header(stamp, _frame(camera)), ("plumb_bob", np.zeros(5))
        return ros.CameraInfo(header, rows, columns, *lens, matrix.ravel(), np.eye(3).ravel(), projection)

    def description(self) -> Any:
        """Returns a URDF, a ``std_msgs/String``: one link with the visual shapes of the robot, its joints at zero."""
        boxes = (Shape("box", Frame(np.array(box.center), np.eye(3)), box.size) for box in self._robot.boxes)
        shapes = self._robot.visuals or [*boxes]
        link = f'<link name="{BASE}">{"".join(map(_visual, shapes))}</link>'
        return ros.String(f"<robot name={quoteattr(self._robot.name)}>{link}</robot>")


def info_topic(image_topic: str) -> str:
    """Returns the topic of the ``sensor_msgs/CameraInfo`` of an image: beside it, as in image_transport."""
    raw = image_topic.removesuffix("/compressed").removesuffix("/compressedDepth")
    return f"{raw.rpartition('/')[0]}/camera_info"


def world_map(world: World) -> Any:
    """Returns the obstacles of a world, a ``nav_msgs/OccupancyGrid`` with cells of 5 cm: 100 occupied, 0 free."""
    xs, ys = (
        low + MAP_CELL * (np.arange(max(1, math.floor((high - low) / MAP_CELL + 1e-6))) + 0.5)
        for low, high in world.terrain.extent
    )
    reach = MAP_CELL / math.sqrt(2)
    occupied = clearance_on_grid(world.terrain, world.obstacles, xs, ys, 2 * reach).numpy() < reach
    corner = ros.Pose(ros.Point(float(xs[0] - MAP_CELL / 2), float(ys[0] - MAP_CELL / 2)))
    about = ros.MapMetaData(resolution=MAP_CELL, width=len(xs), height=len(ys), origin=corner)
    return ros.OccupancyGrid(ros.Header(frame_id=MAP), about, np.where(occupied, OCCUPIED, 0).astype(np.int8).ravel())


def _read(pose: Any) -> tuple[np.ndarray, Rotation]:
    place, turn = pose.position, pose.orientation
    return np.array([place.x, place.y, place.z]), Rotation.from_quat([turn.x, turn.y, turn.z, turn.w])


def _frame(device: Device) -> str:
    return f"{device.name}_link" if device.kind == "points" else f"{device.name}_optical_frame"


def _visual(shape: Shape) -> str:
    angles = Rotation.from_matrix(shape.frame.rotation).as_euler("xyz")
    place = f'<origin xyz="{_text(shape.frame.position)}" rpy="{_text(angles)}"/>'
    if shape.kind == "cylinder":
        sizes = 'radius="{:g}" length="{:g}"'.format(*shape.sizes)
    elif shape.kind == "mesh":
        sizes = f'filename={quoteattr(shape.file)} scale="{_text(shape.sizes)}"'
    else:
        sizes = f'{"radius" if shape.kind == "sphere" else "size"}="{_text(shape.sizes)}"'
    color = f'<material name=""><color rgba="{_text(shape.color or GRAY)} 1"/></material>'
    return f"<visual>{place}<geometry><{shape.kind} {sizes}/></geometry>{color}</visual>"


def _text(numbers: Iterable[float]) -> str:
    return " ".join(f"{number:g}" for number in numbers)
