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


# Fields first.
Time = message_class("builtin_interfaces/msg/Time", base=_Time)
Duration = message_class("builtin_interfaces/msg/Duration")
Header = message_class("std_msgs/msg/Header")
Vector3 = message_class("geometry_msgs/msg/Vector3")
Point = message_class("geometry_msgs/msg/Point")
Quaternion = message_class("geometry_msgs/msg/Quaternion", w=1.0)
Pose = message_class("geometry_msgs/msg/Pose")
PoseStamped = message_class("geometry_msgs/msg/PoseStamped")
PoseArray = message_class("geometry_msgs/msg/PoseArray")
PoseWithCovariance = message_class("geometry_msgs/msg/PoseWithCovariance")
PoseWithCovarianceStamped = message_class("geometry_msgs/msg/PoseWithCovarianceStamped")
Twist = message_class("geometry_msgs/msg/Twist")
TwistStamped = message_class("geometry_msgs/msg/TwistStamped")
TwistWithCovariance = message_class("geometry_msgs/msg/TwistWithCovariance")
Odometry = message_class("nav_msgs/msg/Odometry")
Imu = message_class("sensor_msgs/msg/Imu")
LaserScan = message_class("sensor_msgs/msg/LaserScan")
Image = message_class("sensor_msgs/msg/Image")
CompressedImage = message_class("sensor_msgs/msg/CompressedImage")
RegionOfInterest = message_class("sensor_msgs/msg/RegionOfInterest")
CameraInfo = message_class("sensor_msgs/msg/CameraInfo")
Empty = message_class("std_msgs/msg/Empty")
String = message_class("std_msgs/msg/String")
Transform = message_class("geometry_msgs/msg/Transform")
TransformStamped = message_class("geometry_msgs/msg/TransformStamped")
TFMessage = message_class("tf2_msgs/msg/TFMessage")
MapMetaData = message_class("nav_msgs/msg/MapMetaData")
OccupancyGrid = message_class("nav_msgs/msg/OccupancyGrid")
Clock = message_class("rosgraph_msgs/msg/Clock")
PointField = message_class("sensor_msgs/msg/PointField")
PointCloud2 = message_class("sensor_msgs/msg/PointCloud2")
MultiArrayDimension = message_class("std_msgs/msg/MultiArrayDimension")
MultiArrayLayout = message_class("std_msgs/msg/MultiArrayLayout")
Float32MultiArray = message_class("std_msgs/msg/Float32MultiArray")
GridMapInfo = message_class("grid_map_msgs/msg/GridMapInfo")
GridMap = message_class("grid_map_msgs/msg/GridMap")
Path = message_class("nav_msgs/msg/Path")
ColorRGBA = message_class("std_msgs/msg/ColorRGBA")
UVCoordinate = message_class("visualization_msgs/msg/UVCoordinate")
MeshFile = message_class("visualization_msgs/msg/MeshFile")
Marker = message_class("visualization_msgs/msg/Marker")
MarkerArray = message_class("visualization_msgs/msg/MarkerArray")
KeyValue = message_class("diagnostic_msgs/msg/KeyValue")
DiagnosticStatus = message_class("diagnostic_msgs/msg/DiagnosticStatus")
DiagnosticArray = message_class("diagnostic_msgs/msg/DiagnosticArray")
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
