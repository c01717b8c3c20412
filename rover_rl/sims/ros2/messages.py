"""The ROS 2 messages that the rover speaks, as plain dataclasses with ROS's own field names.

They need no ROS: :mod:`rover_rl.sims.ros2.cdr` writes and reads them as the bytes that go over the wire. Fields and
their order are those of ``common_interfaces`` (``std_msgs``, ``geometry_msgs``, ``sensor_msgs``, ``nav_msgs``), the
same since Humble. How a field lies on the wire is in its annotation: a letter of :mod:`struct`, or an :class:`Array` of
them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Annotated, ClassVar, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray


class Array(NamedTuple):
    """Numbers in a row: of a fixed ``length``, or ``None`` for a sequence of any."""

    letter: str
    length: int | None = None


Int32: TypeAlias = Annotated[int, "i"]
UInt32: TypeAlias = Annotated[int, "I"]
Float32: TypeAlias = Annotated[float, "f"]
Float64: TypeAlias = Annotated[float, "d"]
Float32s: TypeAlias = Annotated[NDArray[np.float32], Array("f")]
Bytes16: TypeAlias = Annotated[NDArray[np.uint8], Array("B", 16)]
Bytes24: TypeAlias = Annotated[NDArray[np.uint8], Array("B", 24)]
Covariance9: TypeAlias = Annotated[NDArray[np.float64], Array("d", 9)]
Covariance36: TypeAlias = Annotated[NDArray[np.float64], Array("d", 36)]


_zeros9: Callable[[], NDArray[np.float64]] = partial(np.zeros, 9)
_zeros36: Callable[[], NDArray[np.float64]] = partial(np.zeros, 36)


class Message:
    """What all messages have: the name of their type.

    Attributes:
        ros_type: as ROS 2 writes it, for example ``"geometry_msgs/msg/Twist"``.
    """

    ros_type: ClassVar[str]


@dataclass
class Time(Message):
    """A moment, or a time since one."""

    ros_type = "builtin_interfaces/msg/Time"
    sec: Int32 = 0
    nanosec: UInt32 = 0

    @classmethod
    def of(cls, seconds: float) -> Time:
        """From seconds."""
        nanoseconds = round(seconds * 1e9)
        return cls(nanoseconds // 1_000_000_000, nanoseconds % 1_000_000_000)

    @property
    def seconds(self) -> float:
        """As one number."""
        return self.sec + self.nanosec * 1e-9


@dataclass
class Header(Message):
    """When and in which frame."""

    ros_type = "std_msgs/msg/Header"
    stamp: Time = field(default_factory=Time)
    frame_id: str = ""


@dataclass
class Vector3(Message):
    """A vector: m/s, rad/s or m/s^2."""

    ros_type = "geometry_msgs/msg/Vector3"
    x: Float64 = 0.0
    y: Float64 = 0.0
    z: Float64 = 0.0


@dataclass
class Point(Message):
    """A place, m."""

    ros_type = "geometry_msgs/msg/Point"
    x: Float64 = 0.0
    y: Float64 = 0.0
    z: Float64 = 0.0


@dataclass
class Quaternion(Message):
    """A rotation."""

    ros_type = "geometry_msgs/msg/Quaternion"
    x: Float64 = 0.0
    y: Float64 = 0.0
    z: Float64 = 0.0
    w: Float64 = 1.0


@dataclass
class Pose(Message):
    """A place and a rotation."""

    ros_type = "geometry_msgs/msg/Pose"
    position: Point = field(default_factory=Point)
    orientation: Quaternion = field(default_factory=Quaternion)


@dataclass
class PoseStamped(Message):
    """A pose at a moment."""

    ros_type = "geometry_msgs/msg/PoseStamped"
    header: Header = field(default_factory=Header)
    pose: Pose = field(default_factory=Pose)


@dataclass
class PoseArray(Message):
    """Poses; the rover's is the first."""

    ros_type = "geometry_msgs/msg/PoseArray"
    header: Header = field(default_factory=Header)
    poses: list[Pose] = field(default_factory=list)


@dataclass
class PoseWithCovariance(Message):
    """A pose and how sure it is."""

    ros_type = "geometry_msgs/msg/PoseWithCovariance"
    pose: Pose = field(default_factory=Pose)
    covariance: Covariance36 = field(default_factory=_zeros36)


@dataclass
class Twist(Message):
    """A velocity; the rover's is ``linear.x`` (m/s) and ``angular.z`` (rad/s)."""

    ros_type = "geometry_msgs/msg/Twist"
    linear: Vector3 = field(default_factory=Vector3)
    angular: Vector3 = field(default_factory=Vector3)


@dataclass
class TwistStamped(Message):
    """A velocity at a moment."""

    ros_type = "geometry_msgs/msg/TwistStamped"
    header: Header = field(default_factory=Header)
    twist: Twist = field(default_factory=Twist)


@dataclass
class TwistWithCovariance(Message):
    """A velocity and how sure it is."""

    ros_type = "geometry_msgs/msg/TwistWithCovariance"
    twist: Twist = field(default_factory=Twist)
    covariance: Covariance36 = field(default_factory=_zeros36)


@dataclass
class Odometry(Message):
    """Pose and velocity as the wheels tell them."""

    ros_type = "nav_msgs/msg/Odometry"
    header: Header = field(default_factory=Header)
    child_frame_id: str = ""
    pose: PoseWithCovariance = field(default_factory=PoseWithCovariance)
    twist: TwistWithCovariance = field(default_factory=TwistWithCovariance)


@dataclass
class Imu(Message):
    """Orientation, rotation (rad/s) and acceleration (m/s^2)."""

    ros_type = "sensor_msgs/msg/Imu"
    header: Header = field(default_factory=Header)
    orientation: Quaternion = field(default_factory=Quaternion)
    orientation_covariance: Covariance9 = field(default_factory=_zeros9)
    angular_velocity: Vector3 = field(default_factory=Vector3)
    angular_velocity_covariance: Covariance9 = field(default_factory=_zeros9)
    linear_acceleration: Vector3 = field(default_factory=Vector3)
    linear_acceleration_covariance: Covariance9 = field(default_factory=_zeros9)


@dataclass
class LaserScan(Message):
    """A scan; angles in rad counter-clockwise from straight ahead of the lidar, times in s, ranges in m."""

    ros_type = "sensor_msgs/msg/LaserScan"
    header: Header = field(default_factory=Header)
    angle_min: Float32 = 0.0
    angle_max: Float32 = 0.0
    angle_increment: Float32 = 0.0
    time_increment: Float32 = 0.0
    scan_time: Float32 = 0.0
    range_min: Float32 = 0.0
    range_max: Float32 = 0.0
    ranges: Float32s = field(default_factory=lambda: np.zeros(0, np.float32))
    intensities: Float32s = field(default_factory=lambda: np.zeros(0, np.float32))


@dataclass
class Clock(Message):
    """The simulation's time."""

    ros_type = "rosgraph_msgs/msg/Clock"
    clock: Time = field(default_factory=Time)
