"""ROS 2 node of a simulated rover, with the topics of the original's rover in Gazebo.

It replaces a real rover or Gazebo in tests and first trials. Every ROS 2 tool can use it.
"""

from __future__ import annotations

import math
import threading
import time
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from rover_rl.sims.base import RoverState, Simulator
from rover_rl.sims.connection import Connection
from rover_rl.sims.ros2.messages import (
    Clock,
    Header,
    Imu,
    LaserScan,
    Odometry,
    Point,
    Pose,
    PoseArray,
    PoseStamped,
    PoseWithCovariance,
    Quaternion,
    Time,
    Twist,
    TwistWithCovariance,
    Vector3,
)
from rover_rl.sims.ros2.readings import read_orientation, read_position
from rover_rl.sims.ros2.settings import Ros2Settings
from rover_rl.sims.ros2.transport import Transport
from rover_rl.sims.rotations import quaternion_to_euler
from rover_rl.sims.worlds import World

COMMAND_LIFETIME = 0.5
"""Simulation time without a command after which the rover stops, as real rovers do, s."""
RANGE_MIN = 0.15
"""Minimum range of the original's lidar, m."""
NOT_MEASURED = -1.0
"""First entry of a covariance that marks a quantity as not measured (``sensor_msgs/Imu``)."""


@dataclass(frozen=True)
class _Command:
    """A command with its sequence number: forward speed (m/s) and yaw rate (rad/s)."""

    speed: float = 0.0
    yaw_rate: float = 0.0
    number: int = 0


class RobotNode:
    """ROS 2 node of a simulated rover: publishes scan, IMU, odometry, pose array and clock; subscribes to commands.

    Args:
        simulator: simulator of one rover.
        transport: transport to publish and subscribe on.
        world: world of the simulator.
        lidar_range: maximum range of the lidar, m.
        settings: topics of odometry, pose and reset, and the direction of the lidar.
        connection: topics of scan, IMU and command.
        start: initial pose: x, y (m) and yaw (rad).
        view: angle that the scans cover, half of it to either side of straight ahead, rad.
    """

    def __init__(
        self,
        simulator: Simulator,
        transport: Transport,
        world: World,
        lidar_range: float,
        settings: Ros2Settings | None = None,
        connection: Connection | None = None,
        start: tuple[float, float, float] = (0.0, 0.0, 0.0),
        view: float = 2 * math.pi,
    ) -> None:
        settings, connection = settings or Ros2Settings(), connection or Connection()
        self._simulator = simulator
        self._settings = settings
        self._world = world
        self._lidar_range, self._view = lidar_range, view
        self._lock = threading.Lock()
        self._command = _Command()
        self._last_number, self._time_without_command = 0, 0.0
        self._reset_pose: tuple[float, float, float] | None = start
        self._yaw = start[2]
        self._odometry = _WheelOdometry()
        # Reliable publishers match every subscription, including those of RViz and of ROS's default profile.
        self._publish_scan = transport.publisher(connection.scan_topic, LaserScan, reliable=True)
        self._publish_imu = transport.publisher(connection.imu_topic, Imu, reliable=True)
        self._publish_odometry = transport.publisher(settings.odometry_topic, Odometry, reliable=True)
        self._publish_poses = transport.publisher(settings.pose_topic, PoseArray, reliable=True)
        self._publish_clock = transport.publisher("/clock", Clock, reliable=True)
        transport.subscribe(connection.cmd_vel_topic, Twist, self._receive_command)
        # Reliable, as a reset pose is sent only once.
        transport.subscribe(settings.reset_topic, PoseStamped, self._receive_reset_pose, reliable=True)

    @property
    def pose(self) -> tuple[float, float, float]:
        """Pose of the rover: x, y (m) and yaw (rad)."""
        state = self._simulator.state()
        x, y, _ = state.position[0].tolist()
        return x, y, quaternion_to_euler(state.orientation)[0, 2].item()

    def run(self, rate: float = 1.0, stop: threading.Event | None = None) -> None:
        """Steps the simulator at a fixed rate until ``stop`` is set.

        Args:
            rate: simulation speed as a multiple of real time.
            stop: event that ends the loop; ``None``: runs until an interrupt.

        Raises:
            ValueError: if the rate is not positive.
        """
        if not 0 < rate < math.inf:
            raise ValueError(f"rate must be positive, got {rate}")
        stop = stop or threading.Event()
        due = time.monotonic()
        while not stop.is_set():
            dt = self.step()
            due = max(due + dt / rate, time.monotonic() - dt / rate)  # does not catch up after a delay
            stop.wait(max(0.0, due - time.monotonic()))

    def step(self) -> float:
        """Runs one control step with the latest command, and publishes the state.

        Returns:
            Duration of the step, s.
        """
        with self._lock:
            reset_pose, self._reset_pose = self._reset_pose, None
            if reset_pose is not None:  # a reset discards earlier commands
                self._command = _Command(number=self._command.number)
            command = self._command
        if reset_pose is not None:
            self._simulator.reset(torch.ones(1, dtype=torch.bool), torch.tensor([reset_pose]))
            self._yaw = reset_pose[2]
        if command.number > self._last_number:
            self._time_without_command = 0.0
        else:
            self._time_without_command += self._dt(self._simulator.state())
        self._last_number = command.number
        if self._time_without_command >= COMMAND_LIFETIME:
            command = _Command()
        state = self._simulator.step(torch.tensor([[command.speed, command.yaw_rate]]))
        self._publish(state)
        return self._dt(state)

    @staticmethod
    def _dt(state: RoverState) -> float:
        return state.dt.item()

    def _receive_command(self, msg: Twist) -> None:
        if not (math.isfinite(msg.linear.x) and math.isfinite(msg.angular.z)):
            raise ValueError(f"a command must be finite, got {msg.linear.x}, {msg.angular.z}")
        with self._lock:
            self._command = _Command(msg.linear.x, msg.angular.z, self._command.number + 1)

    def _receive_reset_pose(self, msg: PoseStamped) -> None:
        x, y, _ = read_position(msg.pose.position).tolist()
        yaw = quaternion_to_euler(read_orientation(msg.pose.orientation))[2].item()
        extent = self._world.terrain.extent
        if not all(low <= value <= high for value, (low, high) in zip((x, y), extent, strict=True)):
            raise ValueError(f"a reset pose must be on the world's terrain, {extent}, got {x}, {y}")
        with self._lock:
            self._reset_pose = (x, y, yaw)

    def _publish(self, state: RoverState) -> None:
        """Publishes a state. The scan comes last, as subscribers wait for it."""
        stamp = Time.from_seconds(state.stamp.item())
        orientation = Quaternion(*state.orientation[0].tolist())
        speed, yaw_rate = state.linear_velocity.item(), state.angular_velocity.item()
        self._odometry.advance(speed, yaw_rate, self._dt(state))
        self._publish_clock(Clock(stamp))
        self._publish_poses(PoseArray(Header(stamp, "world"), [Pose(Point(*state.position[0].tolist()), orientation)]))
        self._publish_imu(self._imu(state, stamp, orientation))
        self._publish_odometry(
            Odometry(
                Header(stamp, "odom"),
                "base_link",
                PoseWithCovariance(self._odometry.pose),
                TwistWithCovariance(Twist(Vector3(x=speed), Vector3(z=yaw_rate))),
            )
        )
        self._publish_scan(self._scan(state.ranges[0], stamp))

    def _imu(self, state: RoverState, stamp: Time, orientation: Quaternion) -> Imu:
        """Builds an IMU message with orientation and yaw rate of the body, and without acceleration.

        The body turns more slowly than wheel odometry reports.
        """
        yaw = quaternion_to_euler(state.orientation)[0, 2].item()
        yaw_rate, self._yaw = math.remainder(yaw - self._yaw, 2 * math.pi) / self._dt(state), yaw
        imu = Imu(Header(stamp, "imu_link"), orientation, angular_velocity=Vector3(z=yaw_rate))
        imu.linear_acceleration_covariance[0] = NOT_MEASURED
        return imu

    def _scan(self, ranges: Tensor, stamp: Time) -> LaserScan:
        """Builds a scan message according to REP 117, with the lidar's zero angle in direction ``lidar_yaw``.

        A full turn begins straight ahead; a narrower view begins at its right edge.
        """
        beams = len(ranges)
        increment = 2 * math.pi / beams
        first, count = 0, beams
        if self._view < 2 * math.pi:
            half = int(self._view / 2 / increment)
            first, count = -half, 2 * half + 1
        readings = ranges.roll(-first)[:count].numpy().astype(np.float32)
        readings[readings > self._lidar_range] = np.inf
        readings[readings < RANGE_MIN] = -np.inf
        angle_min = first * increment - self._settings.lidar_yaw
        return LaserScan(
            Header(stamp, "lidar_link"),
            angle_min=angle_min,
            angle_max=angle_min + (count - 1) * increment,
            angle_increment=increment,
            scan_time=self._simulator.control_dt,
            range_min=RANGE_MIN,
            range_max=self._lidar_range,
            ranges=readings,
        )


class _WheelOdometry:
    """Pose relative to the start by wheel odometry: the integral of the wheels' velocities."""

    def __init__(self) -> None:
        self._x = self._y = self._yaw = 0.0

    def advance(self, speed: float, yaw_rate: float, dt: float) -> None:
        """Integrates a forward speed (m/s) and a yaw rate (rad/s) over ``dt`` (s)."""
        middle = self._yaw + yaw_rate * dt / 2
        self._x += speed * dt * math.cos(middle)
        self._y += speed * dt * math.sin(middle)
        self._yaw += yaw_rate * dt

    @property
    def pose(self) -> Pose:
        """Current pose."""
        return Pose(Point(self._x, self._y), Quaternion(z=math.sin(self._yaw / 2), w=math.cos(self._yaw / 2)))
