from __future__ import annotations

import math
from types import SimpleNamespace as Message

import numpy as np
import pytest

from rover_rl.envs.messages import first_position, imu_euler, odometry_twist, scan_ranges


def imu(x: float, y: float, z: float, w: float) -> Message:
    return Message(orientation=Message(x=x, y=y, z=z, w=w))


def test_a_scan_keeps_its_ranges_as_they_are():
    ranges = scan_ranges(Message(ranges=[1.0, math.inf, math.nan, -math.inf]))
    assert ranges.dtype == np.float32
    np.testing.assert_array_equal(ranges, np.float32([1.0, math.inf, math.nan, -math.inf]))


def test_a_scan_is_copied():
    given = np.ones(3, np.float32)
    scan_ranges(Message(ranges=given))[0] = 7
    assert given[0] == 1


@pytest.mark.parametrize("ranges", [[], 3.0, [[1.0], [2.0]]])
def test_a_scan_needs_a_list_of_ranges(ranges):
    with pytest.raises(ValueError, match="list of ranges"):
        scan_ranges(Message(ranges=ranges))


@pytest.mark.parametrize(
    ("axis", "quaternion"),
    [(0, (1, 0, 0)), (1, (0, 1, 0)), (2, (0, 0, 1))],
    ids=["roll", "pitch", "yaw"],
)
def test_an_orientation_becomes_roll_pitch_yaw(axis, quaternion):
    half = 0.35
    euler = imu_euler(imu(*(math.sin(half) * k for k in quaternion), math.cos(half)))
    expected = np.zeros(3)
    expected[axis] = 2 * half
    assert euler.dtype == np.float32
    np.testing.assert_allclose(euler, expected, atol=1e-6)


def test_angles_are_those_of_rotations_about_fixed_axes():
    """By matrices: roll about x first, then pitch about y, then yaw about z."""
    roll, pitch, yaw = 0.3, -0.5, 2.1
    cr, sr = math.cos(roll / 2), math.sin(roll / 2)
    cp, sp = math.cos(pitch / 2), math.sin(pitch / 2)
    cy, sy = math.cos(yaw / 2), math.sin(yaw / 2)
    x = sr * cp * cy - cr * sp * sy
    y = cr * sp * cy + sr * cp * sy
    z = cr * cp * sy - sr * sp * cy
    w = cr * cp * cy + sr * sp * sy
    np.testing.assert_allclose(imu_euler(imu(x, y, z, w)), (roll, pitch, yaw), atol=1e-6)


def test_an_orientation_of_any_length_is_normalised():
    np.testing.assert_allclose(imu_euler(imu(0, 0, 5, 5)), (0, 0, math.pi / 2), atol=1e-6)


@pytest.mark.parametrize("quaternion", [(0, 0, 0, 0), (math.nan, 0, 0, 1), (math.inf, 0, 0, 1)])
def test_an_orientation_that_is_none_is_refused(quaternion):
    with pytest.raises(ValueError, match="finite quaternion other than zero"):
        imu_euler(imu(*quaternion))


def test_the_first_pose_counts():
    poses = [Message(position=Message(x=float(k), y=2.0, z=3.0)) for k in (1, 9)]
    position = first_position(Message(poses=poses))
    assert position.dtype == np.float32
    assert position.tolist() == [1, 2, 3]


def test_a_pose_array_needs_a_pose():
    with pytest.raises(ValueError, match="at least one pose"):
        first_position(Message(poses=[]))


def test_odometry_gives_forward_speed_and_yaw_rate():
    twist = Message(linear=Message(x=0.5, y=9.0, z=9.0), angular=Message(x=9.0, y=9.0, z=-0.25))
    assert odometry_twist(Message(twist=Message(twist=twist))) == (0.5, -0.25)
