"""Formulas of Coulomb's law, in special cases that have an answer of their own."""

from __future__ import annotations

import math

import pytest

from benchmarks import coulomb
from rover_rl.sims.robots import get_robot

ROVER = get_robot("rover_zero")


def test_the_acceleration_vanishes_at_the_friction_angle() -> None:
    limit = coulomb.friction_angle(0.5)
    assert math.tan(math.radians(limit)) == pytest.approx(0.5)
    assert coulomb.climbing_acceleration(0.5, limit) == pytest.approx(0.0, abs=1e-12)
    assert coulomb.sliding_acceleration(0.5, limit - 1) == 0.0 < coulomb.sliding_acceleration(0.5, limit + 1)


def test_level_ground_and_ground_without_friction() -> None:
    assert coulomb.climbing_acceleration(0.5, 0.0) == pytest.approx(0.5 * 9.81)
    assert coulomb.sliding_acceleration(0.0, 30.0) == pytest.approx(9.81 / 2)
    assert coulomb.climbing_acceleration(0.0, 30.0) == pytest.approx(-9.81 / 2)


def test_the_speed_up_a_slope_takes_its_time() -> None:
    assert coulomb.climbing_time(0.5, 25.0, 1.0) == pytest.approx(3.34, abs=0.01)
    assert coulomb.climbing_time(0.5, 27.0, 1.0) == math.inf


def test_braking_turns_all_of_the_motion_into_heat() -> None:
    """Half of ``m v^2`` is the work of the force ``mu m g`` over the distance."""
    distance = coulomb.braking_distance(0.3, 2.0)
    assert 0.3 * 9.81 * distance == pytest.approx(2.0**2 / 2)


def test_loads_balance_about_the_center_of_mass() -> None:
    center, friction = (0.02, 0.15), 0.4
    front = coulomb.front_load(ROVER, center, friction)
    hubs = ROVER.wheels.hubs
    ahead, behind = max(hub[0] for hub in hubs) - center[0], min(hub[0] for hub in hubs) - center[0]
    height = center[1] - (hubs[0][2] - ROVER.wheels.radius)
    # Pitch moment of the loads and of the friction of a weight of 1.
    assert front * ahead + (1 - front) * behind + friction * height == pytest.approx(0.0, abs=1e-12)
