"""Validation of a robot's parameters."""

from __future__ import annotations

from dataclasses import replace
from math import inf, nan

import pytest

from rover_rl.sims.robots import get_robot

ROVER = get_robot("rover_zero")
FRONT_LEFT, *OTHERS = ROVER.wheel_positions


@pytest.mark.parametrize("field", ["wheel_radius", "wheel_torque", "lidar_range", "radius"])
@pytest.mark.parametrize("value", [0.0, -1.0, nan, inf])
def test_lengths_and_limits_must_be_positive(field, value):
    with pytest.raises(ValueError, match=f"^{field} of robot 'rover_zero' must be a positive number, got {value}$"):
        replace(ROVER, **{field: value})


@pytest.mark.parametrize("field", ["lidar_position", "imu_position"])
@pytest.mark.parametrize("value", [(0.1, nan, 0.2), (inf, 0.0, 0.0), (0.1, 0.2)])
def test_sensor_positions_must_be_finite(field, value):
    with pytest.raises(ValueError, match=f"^{field} of robot 'rover_zero' must have finite coordinates .*, got "):
        replace(ROVER, **{field: value})


@pytest.mark.parametrize("value", [(nan, 0.18, 0.125), (0.1415, 0.18, -inf), (0.1415, 0.18)])
def test_wheel_positions_must_be_finite(value):
    with pytest.raises(
        ValueError, match="^wheel_positions of robot 'rover_zero' must have finite coordinates .*, got "
    ):
        replace(ROVER, wheel_positions=(value, *OTHERS))


@pytest.mark.parametrize("y", [-0.18, 0.0])
def test_left_wheels_must_be_on_the_left(y):
    with pytest.raises(ValueError, match=f"left wheel 'front_left_wheel' at y = {y} m .* left wheels must be at y > 0"):
        replace(ROVER, wheel_positions=((0.1415, y, 0.125), *OTHERS))


def test_right_wheels_must_be_on_the_right():
    with pytest.raises(ValueError, match=r"right wheel 'rear_right_wheel' at y = 0.18 m .* right wheels at y < 0"):
        replace(ROVER, wheel_positions=(FRONT_LEFT, *OTHERS[:-1], (-0.145, 0.18, 0.125)))


@pytest.mark.parametrize(
    "wheels",
    [
        {"left_wheels": (), "right_wheels": (*ROVER.left_wheels, *ROVER.right_wheels)},
        {"left_wheels": ("front_left_wheel", "front_left_wheel")},
        {"right_wheels": ROVER.left_wheels},
    ],
)
def test_each_side_must_have_separate_wheels(wheels):
    with pytest.raises(
        ValueError, match="must have at least one wheel on each side and name each wheel once, got left_"
    ):
        replace(ROVER, **wheels)
