"""Serialization of ROS 2 messages in OMG's Common Data Representation (CDR), by the package rosbags.

Example:
    >>> from rover_rl.sims.ros2.messages import Time
    >>> decode(Time, encode(Time(1, 500_000_000))).seconds
    1.5
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, TypeVar, cast

try:
    from rosbags.serde import SerdeError
    from rosbags.typesys import Stores, get_typestore
    from rosbags.typesys.store import Typestore
except ImportError as error:  # pragma: no cover
    raise ImportError('ROS 2 over DDS requires the package rosbags: pip install "rover_rl[ros2]"') from error

from rover_rl.sims.ros2.messages import Message

M = TypeVar("M", bound=Message)


class MalformedError(ValueError):
    """The bytes are not a message of the expected type."""


def message_types(release: Stores, kinds: Iterable[type[Message]]) -> Typestore:
    """Returns the message definitions of a ROS release, which decode to the classes ``kinds``."""
    store = get_typestore(release)
    store.types.update({kind.ros_type: cast(Any, kind) for kind in kinds})
    return store


COMMON_TYPES = message_types(Stores.ROS2_HUMBLE, Message.__subclasses__())
"""Definitions of :mod:`rover_rl.sims.ros2.messages`, unchanged since Humble."""


def encode(message: Message, types: Typestore = COMMON_TYPES) -> bytes:
    """Serializes a message, little endian.

    Raises:
        ValueError: if an array has the wrong length or the wrong type of numbers.
    """
    try:
        return bytes(types.serialize_cdr(message, message.ros_type, little_endian=True))
    except SerdeError as error:
        raise ValueError(f"{message.ros_type}: {error}") from error


def decode(kind: type[M], data: bytes, types: Typestore = COMMON_TYPES) -> M:
    """Deserializes a message of type ``kind``. Its arrays are read-only.

    Raises:
        MalformedError: if ``data`` is not such a message.
    """
    try:
        return cast(M, types.deserialize_cdr(data, kind.ros_type))
    except SerdeError as error:
        raise MalformedError(f"{kind.ros_type}: {error}") from error
