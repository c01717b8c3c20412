"""ROS 2 messages of the rover as dataclasses, and their serialization in OMG's Common Data Representation (CDR).

The package rosbags, which requires no ROS, has the definitions and serializes. All fields have a default: 0, an empty
text or list, and the identity as orientation.

Example:
    >>> decode("geometry_msgs/msg/Twist", encode(Twist(Vector3(x=0.5)))).linear.x
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
    from rosbags.typesys import Stores, get_typestore
    from rosbags.typesys.store import Typestore
except ImportError as error:  # pragma: no cover
    raise ImportError('ROS 2 requires the package rosbags: pip install "rover_rl[ros2]"') from error

TYPES = get_typestore(Stores.ROS2_HUMBLE)
"""Definitions of ``common_interfaces``, unchanged since Humble."""


class Message:
    """Base class of all messages.

    Attributes:
        ros_type: ROS 2 name of the type, for example ``"geometry_msgs/msg/Twist"``.
    """

    ros_type: ClassVar[str]


class _Time(Message):
    @classmethod
    def from_seconds(cls, seconds: float) -> Any:
        """Converts seconds."""
        nanoseconds = round(seconds * 1e9)
        return cls(nanoseconds // 1_000_000_000, nanoseconds % 1_000_000_000)  # type: ignore[call-arg]


def _message(ros_type: str, base: type[Message] = Message, **defaults: float) -> Any:
    """Makes the class of a message from those of its fields, and decodes messages of the type to it."""
    fields: list[Any] = [
        (name, Any, field(default=defaults[name]) if name in defaults else field(default_factory=_zero(*layout)))
        for name, layout in TYPES.fielddefs[ros_type][1]
    ]
    kind = make_dataclass(ros_type.split("/")[-1], fields, bases=(base,), namespace={"ros_type": ros_type})
    TYPES.types[ros_type] = kind
    return kind


def _zero(node: Nodetype, content: Any) -> Callable[[], Any]:
    """Returns the function that makes the default of a field."""
    if node == Nodetype.NAME:
        return TYPES.types[content]
    if node == Nodetype.BASE:
        return {"string": str, "float32": float, "float64": float}.get(content[0], int)
    (element, name), length = content
    return list if element == Nodetype.NAME else partial(np.zeros, length, name[0])


Time = _message("builtin_interfaces/msg/Time", _Time)
Header = _message("std_msgs/msg/Header")
Vector3 = _message("geometry_msgs/msg/Vector3")
Point = _message("geometry_msgs/msg/Point")
Quaternion = _message("geometry_msgs/msg/Quaternion", w=1.0)
Pose = _message("geometry_msgs/msg/Pose")
PoseStamped = _message("geometry_msgs/msg/PoseStamped")
PoseArray = _message("geometry_msgs/msg/PoseArray")
PoseWithCovariance = _message("geometry_msgs/msg/PoseWithCovariance")
Twist = _message("geometry_msgs/msg/Twist")
TwistStamped = _message("geometry_msgs/msg/TwistStamped")
TwistWithCovariance = _message("geometry_msgs/msg/TwistWithCovariance")
Odometry = _message("nav_msgs/msg/Odometry")
Imu = _message("sensor_msgs/msg/Imu")
LaserScan = _message("sensor_msgs/msg/LaserScan")
Clock = _message("rosgraph_msgs/msg/Clock")


def encode(message: Any, ros_type: str = "", types: Typestore = TYPES) -> bytes:
    """Serializes a message, little endian.

    Args:
        message: message.
        ros_type: ROS 2 name of its type; empty: that of its class.
        types: definitions of messages.

    Raises:
        ValueError: if an array has the wrong length or the wrong type of numbers.
    """
    ros_type = ros_type or message.ros_type
    try:
        return bytes(types.serialize_cdr(message, ros_type, little_endian=True))
    except SerdeError as error:
        raise ValueError(f"{ros_type}: {error}") from error


def decode(ros_type: str, data: bytes, types: Typestore = TYPES) -> Any:
    """Deserializes a message of type ``ros_type``. Its arrays are read-only.

    Raises:
        ValueError: if ``data`` is not such a message.
    """
    try:
        return types.deserialize_cdr(data, ros_type)
    except SerdeError as error:
        raise ValueError(f"{ros_type}: {error}") from error
