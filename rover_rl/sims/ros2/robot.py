"""A simulated rover as a ROS 2 robot: PyBullet's, which publishes what the original's does in Gazebo.

It is what tests and newcomers drive where there is neither a rover nor Gazebo; any ROS 2 tool sees it.
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
"""Seconds of its own time after which a rover that hears no command stops, as real ones do."""
RANGE_MIN = 0.15
"""The original lidar's least range, m."""
UNKNOWN = -1.0
"""First entry of a covariance that says that there is no such measurement (``sensor_msgs/Imu``)."""


@dataclass(frozen=True)
class _Command:
    speed: float = 0.0
    turn: float = 0.0
    number: int = 0


class RobotNode:
    """One rover of a simulator on ROS 2's topics: publishes scan, IMU, odometry, pose array and clock; takes commands.

    Args:
        simulator: of one rover.
        transport: to talk over.
        world: that it drives in.
        lidar_range: of its lidar, m.
        settings: topics that are not the environment's, and how the lidar is mounted.
        connection: topics.
        start: where it stands at first, x, y (m) and yaw (rad).
        view: angle that its scans cover, half of it to either side of straight ahead, rad.
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
        self._obeyed, self._silent = 0, 0.0
        self._placement: tuple[float, float, float] | None = start
        self._yaw = start[2]
        self._odometry = _WheelOdometry()
        # Reliable, so that readers of either kind match, those of RViz and of ROS's defaults, too.
        self._publish_scan = transport.publisher(connection.scan_topic, LaserScan, reliable=True)
        self._publish_imu = transport.publisher(connection.imu_topic, Imu, reliable=True)
        self._publish_odometry = transport.publisher(settings.odometry_topic, Odometry, reliable=True)
        self._publish_poses = transport.publisher(settings.pose_topic, PoseArray, reliable=True)
        self._publish_clock = transport.publisher("/clock", Clock, reliable=True)
        transport.subscribe(connection.cmd_vel_topic, Twist, self._take_command)
        # Sent once: one that is lost would be waited for in vain.
        transport.subscribe(settings.reset_topic, PoseStamped, self._take_placement, reliable=True)

    @property
    def pose(self) -> tuple[float, float, float]:
        """Where it is: x, y (m) and yaw (rad)."""
        state = self._simulator.state()
        x, y, _ = state.position[0].tolist()
        return x, y, quaternion_to_euler(state.orientation)[0, 2].item()

    def run(self, rate: float = 1.0, stop: threading.Event | None = None) -> None:
        """Steps in time with the clock until ``stop`` is set.

        Args:
            rate: times as fast as real time.
            stop: ends it; ``None``: it goes on until it is interrupted.

        Raises:
            ValueError: for a rate that is not positive.
        """
        if not 0 < rate < math.inf:
            raise ValueError(f"rate must be positive, got {rate}")
        stop = stop or threading.Event()
        due = time.monotonic()
        while not stop.is_set():
            dt = self.step()
            due = max(due + dt / rate, time.monotonic() - dt / rate)  # one that is late does not hurry to catch up
            stop.wait(max(0.0, due - time.monotonic()))

    def step(self) -> float:
        """Drives one control step with the newest command, and publishes; returns its length in s."""
        with self._lock:
            placement, self._placement = self._placement, None
            if placement is not None:  # what was said to it before it was put elsewhere is forgotten
                self._command = _Command(number=self._command.number)
            command = self._command
        if placement is not None:
            self._simulator.reset(torch.ones(1, dtype=torch.bool), torch.tensor([placement]))
            self._yaw = placement[2]
        self._silent = 0.0 if command.number > self._obeyed else self._silent + self._dt(self._simulator.state())
        self._obeyed = command.number
        if self._silent >= COMMAND_LIFETIME:
            command = _Command()
        state = self._simulator.step(torch.tensor([[command.speed, command.turn]]))
        self._publish(state)
        return self._dt(state)

    @staticmethod
    def _dt(state: RoverState) -> float:
        return state.dt.item()

    def _take_command(self, msg: Twist) -> None:
        if not (math.isfinite(msg.linear.x) and math.isfinite(msg.angular.z)):
            raise ValueError(f"a command must be finite, got {msg.linear.x}, {msg.angular.z}")
        with self._lock:
            self._command = _Command(msg.linear.x, msg.angular.z, self._command.number + 1)

    def _take_placement(self, msg: PoseStamped) -> None:
        x, y, _ = read_position(msg.pose.position).tolist()
        yaw = quaternion_to_euler(read_orientation(msg.pose.orientation))[2].item()
        extent = self._world.terrain.extent
        if not all(low <= value <= high for value, (low, high) in zip((x, y), extent, strict=True)):
            raise ValueError(f"a place must be on the world's ground, {extent}, got {x}, {y}")
        with self._lock:
            self._placement = (x, y, yaw)

    def _publish(self, state: RoverState) -> None:
        """Publishes a state; the scan last, since it is what others wait for."""
        stamp = Time.of(state.stamp.item())
        orientation = Quaternion(*state.orientation[0].tolist())
        speed, turn = state.linear_velocity.item(), state.angular_velocity.item()
        self._odometry.advance(speed, turn, self._dt(state))
        self._publish_clock(Clock(stamp))
        self._publish_poses(PoseArray(Header(stamp, "world"), [Pose(Point(*state.position[0].tolist()), orientation)]))
        self._publish_imu(self._imu(state, stamp, orientation))
        self._publish_odometry(
            Odometry(
                Header(stamp, "odom"),
                "base_link",
                PoseWithCovariance(self._odometry.pose),
                TwistWithCovariance(Twist(Vector3(x=speed), Vector3(z=turn))),
            )
        )
        self._publish_scan(self._scan(state.ranges[0], stamp))

    def _imu(self, state: RoverState, stamp: Time, orientation: Quaternion) -> Imu:
        """The attitude, and how fast the body turns, which is slower than its wheels say; no acceleration."""
        yaw = quaternion_to_euler(state.orientation)[0, 2].item()
        rate, self._yaw = math.remainder(yaw - self._yaw, 2 * math.pi) / self._dt(state), yaw
        imu = Imu(Header(stamp, "imu_link"), orientation, angular_velocity=Vector3(z=rate))
        imu.linear_acceleration_covariance[0] = UNKNOWN
        return imu

    def _scan(self, ranges: Tensor, stamp: Time) -> LaserScan:
        """The scan as the lidar tells it: its zero points where ``lidar_yaw`` says, and REP 117 holds.

        A full turn begins straight ahead; a narrower view begins on the right.
        """
        beams = len(ranges)
        increment = 2 * math.pi / beams
        first, count = 0, beams
        if self._view < 2 * math.pi:
            side = int(self._view / 2 / increment)
            first, count = -side, 2 * side + 1
        told = ranges.roll(-first)[:count].numpy().astype(np.float32)
        told[told > self._lidar_range] = np.inf
        told[told < RANGE_MIN] = -np.inf
        angle = first * increment - self._settings.lidar_yaw
        return LaserScan(
            Header(stamp, "lidar_link"),
            angle_min=angle,
            angle_max=angle + (count - 1) * increment,
            angle_increment=increment,
            scan_time=self._simulator.control_dt,
            range_min=RANGE_MIN,
            range_max=self._lidar_range,
            ranges=told,
        )


class _WheelOdometry:
    """Where the wheels say that the rover is, from where it began: the integral of their speeds."""

    def __init__(self) -> None:
        self._x = self._y = self._yaw = 0.0

    def advance(self, speed: float, turn: float, dt: float) -> None:
        """Goes on for ``dt`` s at ``speed`` (m/s) and ``turn`` (rad/s)."""
        middle = self._yaw + turn * dt / 2
        self._x += speed * dt * math.cos(middle)
        self._y += speed * dt * math.sin(middle)
        self._yaw += turn * dt

    @property
    def pose(self) -> Pose:
        """Where it has got to."""
        return Pose(Point(self._x, self._y), Quaternion(z=math.sin(self._yaw / 2), w=math.cos(self._yaw / 2)))
