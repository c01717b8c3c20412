"""Kinematics and acceleration limits of the skid-steer drive."""

from __future__ import annotations

from dataclasses import replace

import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from rover_rl.robots import get_robot

ROVER = get_robot("rover_zero")
DRIVE, WHEELS = ROVER.drive, ROVER.wheels
SPEED = st.floats(-3, 3)


@settings(deadline=None)
@given(SPEED, SPEED)
def test_odometry_inverts_the_wheel_speeds(v, w):
    twist = torch.tensor([[v, w]])
    torch.testing.assert_close(DRIVE.odometry(DRIVE.targets(twist, twist, WHEELS), WHEELS), twist, atol=1e-5, rtol=1e-5)


def test_wheel_speeds_of_a_known_twist():
    twist = torch.tensor([[1.0, 2.0]])
    speeds = DRIVE.targets(twist, twist, WHEELS).speeds
    torch.testing.assert_close(speeds, torch.tensor([[(1 - 0.24) / 0.122, (1 + 0.24) / 0.122]]))


def test_the_separation_is_that_of_the_urdf_unless_stated():
    twist = torch.tensor([[0.0, 1.0]])
    geometric = replace(DRIVE, separation=None).targets(twist, twist, WHEELS).speeds
    torch.testing.assert_close(geometric, torch.tensor([[-0.18, 0.18]]) / 0.122)


@settings(deadline=None)
@given(SPEED, SPEED, SPEED, SPEED)
def test_the_drive_respects_its_acceleration_limits_and_does_not_overshoot(v0, w0, v1, w1):
    current, command = torch.tensor([[v0, w0]]), torch.tensor([[v1, w1]])
    after = DRIVE.advance(current, command, WHEELS, 0.05)
    limit = torch.tensor([[5.0 * 0.05, 4.0 * 0.05]])
    assert ((after - current).abs() <= limit + 1e-6).all()
    assert ((command - after).abs() <= (command - current).abs() + 1e-6).all()
