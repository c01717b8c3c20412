from __future__ import annotations

import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from rover_rl.sims.ros2.messages import (
    Header,
    Imu,
    LaserScan,
    Odometry,
    Point,
    Pose,
    PoseArray,
    Quaternion,
    Time,
    Twist,
    TwistWithCovariance,
    Vector3,
)
from rover_rl.sims.ros2.readings import (
    ScanAlignment,
    read_imu,
    read_pose_array,
    read_scan,
    read_twist,
)
from rover_rl.sims.rotations import quaternion_to_euler


def scan(ranges, first=0.0, increment=None) -> LaserScan:
    increment = 2 * math.pi / max(1, len(ranges)) if increment is None else increment
    return LaserScan(
        Header(Time(3, 500_000_000)), angle_min=first, angle_increment=increment, ranges=np.array(ranges, np.float32)
    )


def test_a_scan_keeps_its_ranges_as_they_are():
    ranges = read_scan(scan([1.0, math.inf, math.nan, -math.inf])).ranges
    np.testing.assert_array_equal(ranges, np.float32([1.0, math.inf, math.nan, -math.inf]))


def test_a_scan_is_copied():
    message = scan([1.0, 1.0])
    read_scan(message).ranges[0] = 7
    assert message.ranges[0] == 1


def test_a_scan_tells_its_time():
    assert read_scan(scan([1.0])).stamp == 3.5


@pytest.mark.parametrize("ranges", [[], 3.0, [[1.0], [2.0]]])
def test_a_scan_needs_a_list_of_ranges(ranges):
    message = scan([1.0])
    message.ranges = ranges
    with pytest.raises(ValueError, match="list of ranges"):
        read_scan(message)


@pytest.mark.parametrize(("first", "increment"), [(math.nan, 0.1), (0.0, 0.0), (0.0, math.inf), (math.inf, 0.1)])
def test_a_scan_needs_angles(first, increment):
    with pytest.raises(ValueError, match="must tell its angles"):
        read_scan(scan([1.0, 2.0], first, increment))


def test_a_clockwise_scan_is_turned_round():
    turned = read_scan(scan([1.0, 2.0, 3.0], first=0.5, increment=-0.1))
    assert turned.ranges.tolist() == [3, 2, 1]
    assert turned.first == pytest.approx(0.3)
    assert turned.increment == pytest.approx(0.1)


def by_hand(message: LaserScan, beams: int, yaw: float) -> list[float]:
    """The nearest reading in each beam's share of the turn; a lidar with fewer gives each the reading beside it."""
    count = len(message.ranges)
    angles = [message.angle_min + yaw + k * message.angle_increment for k in range(count)]
    ranges = [math.inf if math.isnan(r) else r for r in message.ranges.tolist()]
    expected = []
    for beam in range(beams):
        middle = 2 * math.pi * beam / beams
        away = [abs(math.remainder(angle - middle, 2 * math.pi)) for angle in angles]
        inside = [r for r, a in zip(ranges, away, strict=True) if a < math.pi / beams]
        beside = min(range(count), key=away.__getitem__)
        near = [ranges[beside]] if away[beside] <= message.angle_increment / 2 else []
        expected.append(min(inside or near or [math.inf]))
    return expected


@settings(deadline=None)
@given(
    readings=st.lists(st.floats(0.1, 12.0) | st.just(math.inf) | st.just(math.nan), min_size=1, max_size=40),
    beams=st.sampled_from([1, 7, 8, 32]),
    yaw=st.sampled_from([0.0, math.pi, 0.3]),
    share=st.floats(0.2, 1.0),
)
def test_a_scan_is_turned_into_the_environments_beams(readings, beams, yaw, share):
    # A little off, so that no reading lies on the border between two beams.
    message = scan(readings, first=-math.pi + 0.00371, increment=share * 2 * math.pi / len(readings))
    got = ScanAlignment(beams, yaw)(read_scan(message))
    assert got.tolist() == pytest.approx(by_hand(message, beams, yaw))


def test_a_full_scan_of_as_many_beams_is_only_turned():
    ranges = torch.arange(8.0)
    behind = scan(ranges.tolist(), first=-math.pi)
    assert ScanAlignment(8, yaw=math.pi)(read_scan(behind)).tolist() == ranges.tolist()
    assert ScanAlignment(8, yaw=0.0)(read_scan(behind)).tolist() == ranges.roll(-4).tolist()


def test_scans_may_change_their_layout():
    align = ScanAlignment(4, 0.0)
    assert align(read_scan(scan([1.0, 2.0, 3.0, 4.0]))).tolist() == [1, 2, 3, 4]
    assert align(read_scan(scan([5.0, 6.0, 7.0, 8.0, 9.0]))).tolist() == [5, 6, 7, 9]
    assert align(read_scan(scan([1.0, 2.0, 3.0, 4.0]))).tolist() == [1, 2, 3, 4]


def test_too_close_stays_too_close():
    assert ScanAlignment(2, 0.0)(read_scan(scan([-math.inf, 1.0]))).tolist() == [-math.inf, 1.0]


def imu(x: float, y: float, z: float, w: float) -> Imu:
    return Imu(orientation=Quaternion(x, y, z, w))


@pytest.mark.parametrize(
    ("axis", "quaternion"), [(0, (1, 0, 0)), (1, (0, 1, 0)), (2, (0, 0, 1))], ids=["roll", "pitch", "yaw"]
)
def test_an_orientation_becomes_roll_pitch_yaw(axis, quaternion):
    half = 0.35
    euler = quaternion_to_euler(read_imu(imu(*(math.sin(half) * k for k in quaternion), math.cos(half))))
    expected = np.zeros(3)
    expected[axis] = 2 * half
    np.testing.assert_allclose(euler, expected, atol=1e-6)


def test_an_orientation_is_normalized():
    np.testing.assert_allclose(read_imu(imu(0.0, 0.0, 3.0, 4.0)), [0, 0, 0.6, 0.8], atol=1e-6)


@pytest.mark.parametrize("quaternion", [(0, 0, 0, 0), (math.nan, 0, 0, 1), (math.inf, 0, 0, 1)])
def test_an_orientation_that_is_none_is_refused(quaternion):
    with pytest.raises(ValueError, match="finite quaternion other than zero"):
        read_imu(imu(*quaternion))


def test_the_first_pose_of_an_array_counts():
    array = PoseArray(poses=[Pose(Point(1.0, 2.0, 3.0)), Pose(Point(9.0, 9.0, 9.0))])
    assert read_pose_array(array).position.tolist() == [1, 2, 3]


def test_an_array_needs_a_pose():
    with pytest.raises(ValueError, match="at least one pose"):
        read_pose_array(PoseArray())
    with pytest.raises(ValueError, match="position must be finite"):
        read_pose_array(PoseArray(poses=[Pose(Point(math.nan, 0.0, 0.0))]))


def test_odometry_gives_speed_and_yaw_rate():
    message = Odometry(twist=TwistWithCovariance(Twist(Vector3(0.5, 7.0, 7.0), Vector3(7.0, 7.0, 0.25))))
    assert read_twist(message).tolist() == [0.5, 0.25]
    message.twist.twist.linear.x = math.nan
    with pytest.raises(ValueError, match="velocity must be finite"):
        read_twist(message)


def test_any_object_with_the_attributes_will_do():
    orientation = SimpleNamespace(x=0.0, y=0.0, z=0.0, w=2.0)
    assert read_imu(SimpleNamespace(orientation=orientation)).tolist() == [0, 0, 0, 1]
