"""ROS 2 messages of the rover as dataclasses, and their serialization in OMG's Common Data Representation (CDR).

The package rosbags, which requires no ROS, has the definitions and serializes. All fields have a default: 0, an empty
text or list, and the identity as orientation.

Example:
    >>> decode(Twist, encode(Twist(Vector3(x=0.5)))).linear.x
    0.5
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import field, make_dataclass
from functools import partial
from typing import Any, ClassVar

import numpy as np

try:
    from rosbags.interfaces import Nodetype
    from rosbags.serde import SerdeError
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore
    from rosbags.typesys.store import Typestore
except ImportError as error:  # pragma: no cover
    raise ImportError('ROS 2 requires the package rosbags: pip install "rover_rl[ros2]"') from error

TYPES = get_typestore(Stores.ROS2_HUMBLE)
"""Definitions of ``common_interfaces``, unchanged since Humble, of grid_map, as in its branch, and of a step."""
_OTHERS = {
    "grid_map_msgs/msg/GridMapInfo": "float64 resolution\nfloat64 length_x\nfloat64 length_y\n"
    "geometry_msgs/Pose pose\n",
    "grid_map_msgs/msg/GridMap": "std_msgs/Header header\nGridMapInfo info\nstring[] layers\nstring[] basic_layers\n"
    "std_msgs/Float32MultiArray[] data\nuint16 outer_start_index\nuint16 inner_start_index\n",
    "rover_rl_msgs/msg/DriveStep": "std_msgs/Header header\ngeometry_msgs/Pose pose\ngeometry_msgs/Twist command\n"
    "float64 dt\nfloat64 latency\nfloat64 distance\nfloat32[] ranges\nbool collision\nbool reached\nbool held\n",
}
for _name, _definition in _OTHERS.items():
    TYPES.register(get_types_from_msg(_definition, _name))


class Message:
    """Base class of all messages, with the ROS 2 name of the type, such as ``"geometry_msgs/msg/Twist"``."""

    ros_type: ClassVar[str]
    types: ClassVar[Typestore]


class _Time(Message):
    @classmethod
    def from_seconds(cls, seconds: float) -> Any:
        return cls(*divmod(round(seconds * 1e9), 1_000_000_000))  # type: ignore[call-arg]


def message_class(ros_type: str, types: Typestore = TYPES, base: type[Message] = Message, **defaults: float) -> Any:
    """Makes the class of a message from those of its fields, and decodes messages of the type to it."""
    fields: list[Any] = [
        (name, Any, field(default=defaults[name]) if name in defaults else field(default_factory=_zero(types, *layout)))
        for name, layout in types.fielddefs[ros_type][1]
    ]
    namespace = {"ros_type": ros_type, "types": types}
    kind = make_dataclass(ros_type.split("/")[-1], fields, bases=(base,), namespace=namespace)
    types.types[ros_type] = kind
    return kind


def _zero(types: Typestore, node: Nodetype, content: Any) -> Callable[[], Any]:
    if node == Nodetype.NAME:
        return types.types[content]
    if node == Nodetype.BASE:
        return {"string": str, "bool": bool, "float32": float, "float64": float}.get(content[0], int)
    (element, name), length = content
    return list if element == Nodetype.NAME or name[0] == "string" else partial(np.zeros, length, name[0])


def _classes(package: str, names: str) -> list[Any]:
    return [message_class(f"{package}/msg/{name}") for name in names.split()]


# The class of a field is made before that of its message.
Time = message_class("builtin_interfaces/msg/Time", base=_Time)
Duration = message_class("builtin_interfaces/msg/Duration")
Header, Empty, String, ColorRGBA = _classes("std_msgs", "Header Empty String ColorRGBA")
MultiArrayDimension, MultiArrayLayout = _classes("std_msgs", "MultiArrayDimension MultiArrayLayout")
Float32MultiArray = message_class("std_msgs/msg/Float32MultiArray")
Quaternion = message_class("geometry_msgs/msg/Quaternion", w=1.0)
Vector3, Point, Pose, PoseStamped, PoseArray = _classes("geometry_msgs", "Vector3 Point Pose PoseStamped PoseArray")
PoseWithCovariance = message_class("geometry_msgs/msg/PoseWithCovariance")
PoseWithCovarianceStamped = message_class("geometry_msgs/msg/PoseWithCovarianceStamped")
Twist, TwistStamped, TwistWithCovariance = _classes("geometry_msgs", "Twist TwistStamped TwistWithCovariance")
Transform, TransformStamped = _classes("geometry_msgs", "Transform TransformStamped")
TFMessage = message_class("tf2_msgs/msg/TFMessage")
Clock = message_class("rosgraph_msgs/msg/Clock")
Odometry, Path, MapMetaData, OccupancyGrid = _classes("nav_msgs", "Odometry Path MapMetaData OccupancyGrid")
Imu, LaserScan, Image, CompressedImage = _classes("sensor_msgs", "Imu LaserScan Image CompressedImage")
RegionOfInterest, CameraInfo = _classes("sensor_msgs", "RegionOfInterest CameraInfo")
PointField, PointCloud2 = _classes("sensor_msgs", "PointField PointCloud2")
GridMapInfo, GridMap = _classes("grid_map_msgs", "GridMapInfo GridMap")
UVCoordinate, MeshFile = _classes("visualization_msgs", "UVCoordinate MeshFile")
Marker, MarkerArray = _classes("visualization_msgs", "Marker MarkerArray")
KeyValue, DiagnosticStatus, DiagnosticArray = _classes("diagnostic_msgs", "KeyValue DiagnosticStatus DiagnosticArray")
DriveStep = message_class("rover_rl_msgs/msg/DriveStep")


def encode(message: Message) -> bytes:
    """Serializes a message, little endian. Raises ``ValueError`` if an array has the wrong length or number type."""
    try:
        return bytes(message.types.serialize_cdr(message, message.ros_type, little_endian=True))
    except SerdeError as error:
        raise ValueError(f"{message.ros_type}: {error}") from error


def decode(kind: type[Message], data: bytes) -> Any:
    """Deserializes a message of class ``kind``, with read-only arrays. Raises ``ValueError`` if ``data`` is no such."""
    try:
        return kind.types.deserialize_cdr(data, kind.ros_type)
    except SerdeError as error:
        raise ValueError(f"{kind.ros_type}: {error}") from error


def seconds_of(time: Any) -> float:
    return float(time.sec + 1e-9 * time.nanosec)
