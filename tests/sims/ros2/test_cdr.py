from __future__ import annotations

import dataclasses
import math
import typing

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rover_rl.sims.ros2 import messages
from rover_rl.sims.ros2.cdr import MalformedError, decode, encode
from rover_rl.sims.ros2.messages import Array, Message

stores = pytest.importorskip("rosbags.typesys", reason="rosbags, the oracle, is not installed")
ORACLE = stores.get_typestore(stores.Stores.ROS2_HUMBLE)

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
WHOLE = {"i": (-(2**31), 2**31 - 1), "I": (0, 2**32 - 1), "B": (0, 255)}


def numbers(letter: str) -> st.SearchStrategy:
    if letter in WHOLE:
        return st.integers(*WHOLE[letter])
    return st.floats(width=32 if letter == "f" else 64)


def values(hint: object) -> st.SearchStrategy:
    """Any value that a field with that annotation may have."""
    if hint is str:
        return st.text(st.characters(blacklist_categories=["Cs"], blacklist_characters="\0"), max_size=9)
    if typing.get_origin(hint) is typing.Annotated:
        (form,) = hint.__metadata__
        if not isinstance(form, Array):
            return numbers(form)
        size = {"max_size": 5} if form.length is None else {"min_size": form.length, "max_size": form.length}
        return st.lists(numbers(form.letter), **size).map(lambda row: np.array(row, form.letter))
    if typing.get_origin(hint) is list:
        return st.lists(values(*typing.get_args(hint)), max_size=3)
    return any_message(hint)


def any_message(kind: type[Message]) -> st.SearchStrategy:
    hints = typing.get_type_hints(kind, include_extras=True)
    return st.builds(kind, **{field.name: values(hints[field.name]) for field in dataclasses.fields(kind)})


def to_oracle(message: object) -> object:
    """The same message as rosbags has it."""
    if not isinstance(message, Message):
        return [to_oracle(item) for item in message] if isinstance(message, list) else message
    kind = ORACLE.types[message.ros_type]
    return kind(**{f.name: to_oracle(getattr(message, f.name)) for f in dataclasses.fields(message)})


def same(a: object, b: object) -> bool:
    """Whether two messages say the same, NaN included."""
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
def test_bytes_are_those_of_rosbags_both_ways(kind, data):
    message = data.draw(any_message(kind))
    expected = bytes(ORACLE.serialize_cdr(to_oracle(message), kind.ros_type))
    assert encode(message) == expected
    assert same(decode(kind, expected), message)


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.__name__)
@settings(deadline=None)
@given(data=st.data())
def test_big_endian_messages_are_read(kind, data):
    message = data.draw(any_message(kind))
    big = bytes(ORACLE.serialize_cdr(to_oracle(message), kind.ros_type, little_endian=False))
    assert same(decode(kind, big), message)


def refusal(kind: type[Message], payload: bytes) -> str:
    """What is said of a payload that is no message; the type's name where it is one."""
    try:
        decode(kind, payload)
    except MalformedError as error:
        return str(error)
    return kind.ros_type


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.__name__)
@settings(deadline=None)
@given(data=st.data())
def test_what_is_cut_short_or_random_is_refused_or_read_but_never_crashes(kind, data):
    whole = encode(data.draw(any_message(kind)))
    cut = whole[: data.draw(st.integers(0, len(whole) - 1))]
    for payload in (cut, data.draw(st.binary(max_size=200)), whole[:4] + data.draw(st.binary(max_size=200))):
        assert kind.ros_type in refusal(kind, payload)


def test_a_message_that_is_cut_short_is_refused():
    whole = encode(messages.LaserScan(ranges=np.ones(8, np.float32)))
    for length in range(len(whole)):
        with pytest.raises(MalformedError):
            decode(messages.LaserScan, whole[:length])


def test_announced_lengths_are_not_believed():
    header = b"\x00\x01\x00\x00" + bytes(8)
    for kind in (messages.LaserScan, messages.PoseArray):
        with pytest.raises(MalformedError, match="announced"):
            decode(kind, header + b"\xff\xff\xff\x7f" + bytes(40))


def test_other_representations_are_refused():
    with pytest.raises(MalformedError, match="plain CDR"):
        decode(messages.Twist, b"\x00\x03\x00\x00" + bytes(48))


def test_a_covariance_has_its_length():
    with pytest.raises(ValueError, match="expected 9 numbers"):
        encode(messages.Imu(orientation_covariance=np.zeros(4)))


def test_seconds_become_whole_seconds_and_nanoseconds():
    stamp = messages.Time.of(12.25)
    assert (stamp.sec, stamp.nanosec, stamp.seconds) == (12, 250_000_000, 12.25)
    assert messages.Time.of(-0.5) == messages.Time(-1, 500_000_000)
    assert math.isclose(messages.Time.of(1e9 + 0.1).seconds, 1e9 + 0.1)
