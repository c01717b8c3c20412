"""Kinematics and acceleration limits of the differential drive."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from rover_rl.sims.differential_drive import DifferentialDrive
from rover_rl.sims.robots import get_robot

ROVER = get_robot("rover_zero")
DRIVE = DifferentialDrive(ROVER, dt=0.05)
SPEED = st.floats(-3, 3)


@given(SPEED, SPEED)
def test_odometry_inverts_the_wheel_speeds(v, w):
    twist = torch.tensor([[v, w]])
    torch.testing.assert_close(DRIVE.odometry(DRIVE.wheel_speeds(twist)), twist, atol=1e-5, rtol=1e-5)


def test_wheel_speeds_of_a_known_twist():
    speeds = DRIVE.wheel_speeds(torch.tensor([[1.0, 2.0]]))
    torch.testing.assert_close(speeds, torch.tensor([[(1 - 0.24) / 0.122, (1 + 0.24) / 0.122]]))


@given(SPEED, SPEED, SPEED, SPEED)
def test_ramp_respects_the_acceleration_limits_and_does_not_overshoot(v0, w0, v1, w1):
    current, command = torch.tensor([[v0, w0]]), torch.tensor([[v1, w1]])
    after = DRIVE.ramp(current, command)
    limit = torch.tensor([[5.0 * 0.05, 4.0 * 0.05]])
    assert ((after - current).abs() <= limit + 1e-6).all()
    assert ((command - after).abs() <= (command - current).abs() + 1e-6).all()


def test_parameters_of_rover_zero():
    assert ROVER.wheel_radius == 0.122
    assert ROVER.wheel_separation == 0.24
    assert ROVER.max_linear_acceleration == 5.0
    assert ROVER.max_angular_acceleration == 4.0
    assert ROVER.lidar_position == (0.174, 0.0, 0.321)
    assert ROVER.imu_position == (0.0, 0.0, 0.221)
    assert ROVER.lidar_range == 12.0


def test_invalid_parameters_raise():
    from dataclasses import replace

    with pytest.raises(ValueError, match="wheel_radius .* positive"):
        replace(ROVER, wheel_radius=0.0)
    with pytest.raises(FileNotFoundError, match=r"nowhere\.urdf"):
        replace(ROVER, urdf="nowhere.urdf")
    with pytest.raises(ValueError, match="2 left and 1 right wheels"):
        replace(ROVER, right_wheels=("front_right_wheel",))
    with pytest.raises(ValueError, match="unknown robot 'tank'.*rover_zero"):
        get_robot("tank")
