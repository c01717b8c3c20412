"""Validation of a robot's parameters."""

from __future__ import annotations

import warnings
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


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"radius": 0.2}, r"^radius of robot 'rover_zero' is 0.2 m, and its body and wheels reach 0.267 m .* 0.349 m"),
        (
            {"lidar_position": (0.6, 0.0, 0.3)},
            r"is at x = 0.6, y = 0 m, 0.337 m outside of its body and outside of its",
        ),
        ({"lidar_position": (0.1, 0.0, -0.1)}, r"^the lidar of robot 'rover_zero' is at z = -0.1 m; it must be above"),
        (
            {"wheel_torque": 0.1},
            r"push with 3.28 N \(4 x 0.1 N m on a radius of 0.122 m\), and it has .* kg: it cannot",
        ),
    ],
)
def test_a_robot_that_cannot_drive_is_refused_with_numbers(changes, message):
    with pytest.raises(ValueError, match=message) as error:
        replace(ROVER, **changes)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"radius": 0.3}, r"radius of robot 'rover_zero' is 0.3 m, and its corners are 0.349 m from the origin"),
        ({"lidar_position": (0.3, 0.0, 0.3)}, r"0.0365 m outside of its body: check lidar_position"),
        ({"wheel_torque": 0.5}, r"push with 16.4 N .* it cannot climb a slope of more than \d+ degrees"),
    ],
)
def test_an_unusual_robot_is_warned_of_with_numbers(changes, message):
    with pytest.warns(UserWarning, match=message):
        replace(ROVER, **changes)


def test_a_usual_robot_is_not_warned_of():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        replace(ROVER, radius=0.5, wheel_torque=3.0)
