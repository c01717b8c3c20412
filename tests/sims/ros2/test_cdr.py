from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

pytest.importorskip("rosbags", reason="needs rover_rl[ros2]")

from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_typestore

from rover_rl.sims.ros2 import messages
from rover_rl.sims.ros2.cdr import MalformedError, decode, encode
from rover_rl.sims.ros2.messages import Message

ROSBAGS = get_typestore(Stores.ROS2_HUMBLE)

KINDS = [
    messages.LaserScan,
    messages.Imu,
    messages.Odometry,
    messages.PoseArray,
    messages.Twist,
    messages.PoseStamped,
    messages.TwistStamped,
    messages.Clock,
]
NUMBERS = {
    "int32": st.integers(-(2**31), 2**31 - 1),
    "uint32": st.integers(0, 2**32 - 1),
    "float32": st.floats(width=32),
    "float64": st.floats(),
    "string": st.text(st.characters(blacklist_categories=["Cs"], blacklist_characters="\0"), max_size=9),
}
CLASSES = {kind.ros_type: kind for kind in Message.__subclasses__()}


def values(layout: tuple) -> st.SearchStrategy:
    """Values of a field, from rosbags' definition."""
    node, content = layout
    if node == Nodetype.BASE:
        return NUMBERS[content[0]]
    if node == Nodetype.NAME:
        return any_message(CLASSES[content])
    element, length = content
    size = {"min_size": length, "max_size": length} if node == Nodetype.ARRAY else {"max_size": 3}
    rows = st.lists(values(element), **size)
    return rows if element[0] == Nodetype.NAME else rows.map(lambda row: np.array(row, element[1][0]))


def any_message(kind: type[Message]) -> st.SearchStrategy:
    return st.builds(kind, **{name: values(layout) for name, layout in ROSBAGS.fielddefs[kind.ros_type][1]})


def to_rosbags(message: object) -> object:
    """Converts a message to rosbags' class."""
    if not isinstance(message, Message):
        return [to_rosbags(item) for item in message] if isinstance(message, list) else message
    kind = ROSBAGS.types[message.ros_type]
    return kind(**{f.name: to_rosbags(getattr(message, f.name)) for f in dataclasses.fields(message)})


def same(a: object, b: object) -> bool:
    """Whether two messages are equal; NaN equals NaN."""
    if isinstance(a, np.ndarray):
        return a.shape == b.shape and a.tobytes() == b.tobytes()
    if isinstance(a, list):
        return len(a) == len(b) and all(map(same, a, b))
    if dataclasses.is_dataclass(a):
        return all(same(getattr(a, f.name), getattr(b, f.name)) for f in dataclasses.fields(a))
    return a == b or (a != a and b != b)


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.__name__)
@settings(deadline=None)
@given(data=st.data())
def test_encode_and_decode_match_rosbags(kind, data):
    message = data.draw(any_message(kind))
    expected = bytes(ROSBAGS.serialize_cdr(to_rosbags(message), kind.ros_type))
    assert encode(message) == expected
    assert same(decode(kind, expected), message)


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.__name__)
@settings(deadline=None)
@given(data=st.data())
def test_big_endian_messages_are_decoded(kind, data):
    message = data.draw(any_message(kind))
    big = bytes(ROSBAGS.serialize_cdr(to_rosbags(message), kind.ros_type, little_endian=False))
    assert same(decode(kind, big), message)


def error_text(kind: type[Message], payload: bytes) -> str:
    """Returns the error text for a payload that is not a message; the type's name for a valid message."""
    try:
        decode(kind, payload)
    except MalformedError as error:
        return str(error)
    return kind.ros_type


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.__name__)
@settings(deadline=None)
@given(data=st.data())
def test_truncated_and_random_bytes_are_decoded_or_rejected_without_a_crash(kind, data):
    encoded = encode(data.draw(any_message(kind)))
    truncated = encoded[: data.draw(st.integers(0, len(encoded) - 1))]
    for payload in (truncated, data.draw(st.binary(max_size=200)), encoded[:4] + data.draw(st.binary(max_size=200))):
        assert kind.ros_type in error_text(kind, payload)


def test_a_truncated_message_is_rejected():
    encoded = encode(messages.LaserScan(ranges=np.ones(8, np.float32)))
    for length in range(len(encoded)):
        with pytest.raises(MalformedError):
            decode(messages.LaserScan, encoded[:length])


def test_announced_lengths_are_checked():
    header = b"\x00\x01\x00\x00" + bytes(8)
    for kind in (messages.LaserScan, messages.PoseArray):
        with pytest.raises(MalformedError, match="Invalid sequence length|Invalid string length"):
            decode(kind, header + b"\xff\xff\xff\x7f" + bytes(40))


def test_other_representations_are_rejected():
    with pytest.raises(MalformedError, match="CDR encapsulation"):
        decode(messages.Twist, b"\x00\x03\x00\x00" + bytes(48))


def test_an_array_of_wrong_length_is_rejected():
    with pytest.raises(ValueError, match="Unexpected array length"):
        encode(messages.Imu(orientation_covariance=np.zeros(4)))


def test_time_converts_from_and_to_seconds():
    stamp = messages.Time.from_seconds(12.25)
    assert (stamp.sec, stamp.nanosec, stamp.seconds) == (12, 250_000_000, 12.25)
    assert messages.Time.from_seconds(-0.5) == messages.Time(-1, 500_000_000)
    assert math.isclose(messages.Time.from_seconds(1e9 + 0.1).seconds, 1e9 + 0.1)
