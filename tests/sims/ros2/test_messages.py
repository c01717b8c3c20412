from __future__ import annotations

from contextlib import suppress

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rover_rl.sims.ros2 import messages
from rover_rl.sims.ros2.messages import Header, Imu, LaserScan, Pose, PoseArray, Quaternion, Time, decode, encode

HEADER = Header(Time(1, 2), "lidar")
LONG = b"\x00\x01\x00\x00" + bytes(8) + b"\xff\xff\xff\x7f" + bytes(40)
SENT = [
    LaserScan(HEADER, range_max=10.0, ranges=np.ones(8, np.float32)),
    Imu(HEADER),
    messages.Odometry(HEADER, "base_link"),
    PoseArray(HEADER, [Pose(), Pose()]),
    messages.Twist(messages.Vector3(x=0.5)),
    messages.PoseStamped(HEADER),
    messages.TwistStamped(HEADER),
    messages.Clock(Time(7)),
    messages.PointCloud2(HEADER, fields=[messages.PointField("x")], is_bigendian=True, data=np.ones(8, np.uint8)),
    messages.Contacts(HEADER, [messages.Contact(messages.Entity(2**40, "wall", 5), wrenches=[messages.JointWrench()])]),
    messages.GridMap(HEADER, layers=["elevation"], data=[messages.Float32MultiArray(data=np.ones(2, np.float32))]),
]


@pytest.mark.parametrize("message", SENT, ids=lambda message: message.ros_type)
@settings(deadline=None)
@given(data=st.data())
def test_truncated_and_random_bytes_are_decoded_or_rejected_without_a_crash(message, data):
    encoded = encode(message)
    assert encode(decode(type(message), encoded)) == encoded
    truncated = encoded[: data.draw(st.integers(0, len(encoded) - 1))]
    with pytest.raises(ValueError, match=message.ros_type):
        decode(type(message), truncated)
    for payload in (data.draw(st.binary(max_size=200)), encoded[:4] + data.draw(st.binary(max_size=200))):
        with suppress(ValueError):
            decode(type(message), payload)


def test_fields_have_defaults():
    imu = Imu()
    assert imu.header == Header(Time(0, 0), "")
    assert imu.orientation == Quaternion(0.0, 0.0, 0.0, 1.0)
    assert imu.orientation_covariance.tolist() == [0.0] * 9
    assert imu.orientation_covariance is not Imu().orientation_covariance
    assert PoseArray().poses == []
    assert LaserScan().ranges.dtype == np.float32


@pytest.mark.parametrize(
    ("kind", "payload", "message"),
    [
        (LaserScan, LONG, "Invalid sequence length|Invalid string length"),
        (PoseArray, LONG, "Invalid sequence length|Invalid string length"),
        (messages.Twist, b"\x00\x03\x00\x00" + bytes(48), "CDR encapsulation"),
    ],
    ids=["a text of 2 GB", "a sequence of 2 GB", "another representation"],
)
def test_announced_lengths_and_the_representation_are_checked(kind, payload, message):
    with pytest.raises(ValueError, match=message):
        decode(kind, payload)


def test_an_array_of_wrong_length_is_rejected():
    with pytest.raises(ValueError, match="Unexpected array length"):
        encode(Imu(orientation_covariance=np.zeros(4)))


def test_a_time_is_made_from_seconds():
    assert Time.from_seconds(12.25) == Time(12, 250_000_000)
    assert Time.from_seconds(-0.5) == Time(-1, 500_000_000)
