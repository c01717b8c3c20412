from __future__ import annotations

from contextlib import suppress

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rover_rl.sims.ros2 import messages as ros

HEADER = ros.Header(ros.Time(1, 2), "lidar")
SENT = [
    ros.LaserScan(HEADER, range_max=10.0, ranges=np.ones(8, np.float32)),
    ros.Imu(HEADER),
    ros.PoseArray(HEADER, [ros.Pose(), ros.Pose()]),
    ros.PointCloud2(HEADER, fields=[ros.PointField("x")], is_bigendian=True, data=np.ones(8, np.uint8)),
    ros.GridMap(HEADER, layers=["elevation"], data=[ros.Float32MultiArray(data=np.ones(2, np.float32))]),
]


@pytest.mark.parametrize("message", SENT, ids=lambda message: message.ros_type)
@settings(deadline=None, max_examples=40)
@given(data=st.data())
def test_truncated_and_random_bytes_are_decoded_or_rejected_without_a_crash(message, data):
    encoded = ros.encode(message)
    assert ros.encode(ros.decode(type(message), encoded)) == encoded
    truncated = encoded[: data.draw(st.integers(0, len(encoded) - 1))]
    with pytest.raises(ValueError, match=message.ros_type):
        ros.decode(type(message), truncated)
    for payload in (data.draw(st.binary(max_size=200)), encoded[:4] + data.draw(st.binary(max_size=200))):
        with suppress(ValueError):
            ros.decode(type(message), payload)


def test_fields_have_defaults_and_a_time_is_made_from_seconds():
    imu = ros.Imu()
    assert imu.header == ros.Header(ros.Time(0, 0), "")
    assert imu.orientation == ros.Quaternion(0.0, 0.0, 0.0, 1.0)
    assert imu.orientation_covariance.tolist() == [0.0] * 9
    assert imu.orientation_covariance is not ros.Imu().orientation_covariance
    assert ros.PoseArray().poses == []
    assert ros.Time.from_seconds(12.25) == ros.Time(12, 250_000_000)
    assert ros.Time.from_seconds(-0.5) == ros.Time(-1, 500_000_000)


def test_each_class_has_the_name_of_its_type():
    kinds = {name: kind.ros_type for name, kind in vars(ros).items() if hasattr(kind, "ros_type")}
    assert all(kind.endswith(f"/msg/{name}") for name, kind in kinds.items())


def test_announced_lengths_are_checked():
    long = b"\x00\x01\x00\x00" + bytes(8) + b"\xff\xff\xff\x7f" + bytes(40)
    with pytest.raises(ValueError, match="Invalid sequence length|Invalid string length"):
        ros.decode(ros.LaserScan, long)
    with pytest.raises(ValueError, match="Unexpected array length"):
        ros.encode(ros.Imu(orientation_covariance=np.zeros(4)))
