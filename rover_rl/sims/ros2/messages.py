"""ROS 2 messages of the rover as plain dataclasses with the field names of ROS.

They do not require ROS: :mod:`rover_rl.sims.ros2.cdr` serializes and deserializes them. Fields and their order are
those of ``common_interfaces`` (``std_msgs``, ``geometry_msgs``, ``sensor_msgs``, ``nav_msgs``), unchanged since Humble.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

_zeros9: Callable[[], NDArray[np.float64]] = partial(np.zeros, 9)
_zeros36: Callable[[], NDArray[np.float64]] = partial(np.zeros, 36)


class Message:
    """Base class of all messages.

    Attributes:
        ros_type: ROS 2 name of the type, for example ``"geometry_msgs/msg/Twist"``.
    """

    ros_type: ClassVar[str]


@dataclass
class Time(Message):
    """A point in time or a duration."""

    ros_type = "builtin_interfaces/msg/Time"
    sec: int = 0
    nanosec: int = 0

    @classmethod
    def from_seconds(cls, seconds: float) -> Time:
        """Converts seconds."""
        nanoseconds = round(seconds * 1e9)
        return cls(nanoseconds // 1_000_000_000, nanoseconds % 1_000_000_000)

    @property
    def seconds(self) -> float:
        """Time in seconds."""
        return self.sec + self.nanosec * 1e-9


@dataclass
class Header(Message):
    """Time stamp and frame of a message."""

    ros_type = "std_msgs/msg/Header"
    stamp: Time = field(default_factory=Time)
    frame_id: str = ""


@dataclass
class Vector3(Message):
    """A vector, in m/s, rad/s or m/s^2."""

    ros_type = "geometry_msgs/msg/Vector3"
    x: float = 0.0
    y: float = 0.0
    z: float = 0.0


@dataclass
class Point(Message):
    """A position, m."""

    ros_type = "geometry_msgs/msg/Point"
    x: float = 0.0
    y: float = 0.0
    z: float = 0.0


@dataclass
class Quaternion(Message):
    """An orientation as a quaternion."""

    ros_type = "geometry_msgs/msg/Quaternion"
    x: float = 0.0
    y: float = 0.0
    z: float = 0.0
    w: float = 1.0


@dataclass
class Pose(Message):
    """A position and an orientation."""

    ros_type = "geometry_msgs/msg/Pose"
    position: Point = field(default_factory=Point)
    orientation: Quaternion = field(default_factory=Quaternion)


@dataclass
class PoseStamped(Message):
    """A pose with a time stamp and a frame."""

    ros_type = "geometry_msgs/msg/PoseStamped"
    header: Header = field(default_factory=Header)
    pose: Pose = field(default_factory=Pose)


@dataclass
class PoseArray(Message):
    """Poses in one frame. The rover's pose is the first."""

    ros_type = "geometry_msgs/msg/PoseArray"
    header: Header = field(default_factory=Header)
    poses: list[Pose] = field(default_factory=list)


@dataclass
class PoseWithCovariance(Message):
    """A pose with its covariance."""

    ros_type = "geometry_msgs/msg/PoseWithCovariance"
    pose: Pose = field(default_factory=Pose)
    covariance: NDArray[np.float64] = field(default_factory=_zeros36)


@dataclass
class Twist(Message):
    """Linear and angular velocity. The rover uses ``linear.x`` (m/s) and ``angular.z`` (rad/s)."""

    ros_type = "geometry_msgs/msg/Twist"
    linear: Vector3 = field(default_factory=Vector3)
    angular: Vector3 = field(default_factory=Vector3)


@dataclass
class TwistStamped(Message):
    """A velocity with a time stamp and a frame."""

    ros_type = "geometry_msgs/msg/TwistStamped"
    header: Header = field(default_factory=Header)
    twist: Twist = field(default_factory=Twist)


@dataclass
class TwistWithCovariance(Message):
    """A velocity with its covariance."""

    ros_type = "geometry_msgs/msg/TwistWithCovariance"
    twist: Twist = field(default_factory=Twist)
    covariance: NDArray[np.float64] = field(default_factory=_zeros36)


@dataclass
class Odometry(Message):
    """Pose and velocity by odometry."""

    ros_type = "nav_msgs/msg/Odometry"
    header: Header = field(default_factory=Header)
    child_frame_id: str = ""
    pose: PoseWithCovariance = field(default_factory=PoseWithCovariance)
    twist: TwistWithCovariance = field(default_factory=TwistWithCovariance)


@dataclass
class Imu(Message):
    """Orientation, angular velocity (rad/s) and linear acceleration (m/s^2)."""

    ros_type = "sensor_msgs/msg/Imu"
    header: Header = field(default_factory=Header)
    orientation: Quaternion = field(default_factory=Quaternion)
    orientation_covariance: NDArray[np.float64] = field(default_factory=_zeros9)
    angular_velocity: Vector3 = field(default_factory=Vector3)
    angular_velocity_covariance: NDArray[np.float64] = field(default_factory=_zeros9)
    linear_acceleration: Vector3 = field(default_factory=Vector3)
    linear_acceleration_covariance: NDArray[np.float64] = field(default_factory=_zeros9)


@dataclass
class LaserScan(Message):
    """A lidar scan. Angles in rad, counter-clockwise from the lidar's x axis; times in s; ranges in m."""

    ros_type = "sensor_msgs/msg/LaserScan"
    header: Header = field(default_factory=Header)
    angle_min: float = 0.0
    angle_max: float = 0.0
    angle_increment: float = 0.0
    time_increment: float = 0.0
    scan_time: float = 0.0
    range_min: float = 0.0
    range_max: float = 0.0
    ranges: NDArray[np.float32] = field(default_factory=lambda: np.zeros(0, np.float32))
    intensities: NDArray[np.float32] = field(default_factory=lambda: np.zeros(0, np.float32))


@dataclass
class Clock(Message):
    """Simulation time."""

    ros_type = "rosgraph_msgs/msg/Clock"
    clock: Time = field(default_factory=Time)
