"""Every simulator obeys Coulomb's law of friction, by the calculations of ``benchmarks.coulomb``, in 16 directions."""

from __future__ import annotations

import math

import pytest
import torch

from benchmarks import coulomb, maneuvers
from benchmarks.engines import with_friction
from benchmarks.law import center_of_mass
from rover_rl.robots import get_robot

FRICTION = 0.5
LIMIT = coulomb.friction_angle(FRICTION)
LEVEL_MESH = maneuvers.incline(maneuvers.NEARLY_LEVEL, size=12.0)
"""Level ground of triangles, large enough for all maneuvers here."""
GROUNDS = pytest.mark.parametrize("ground", [maneuvers.PLANE, LEVEL_MESH], ids=["on a plane", "on triangles"])
EVERY_SECOND = torch.arange(16) % 2 == 0
HALVES = pytest.mark.parametrize("gentle", [EVERY_SECOND, ~EVERY_SECOND], ids=["even", "odd"])


def assert_all_close(values: torch.Tensor, expected: float, *, tolerance: float) -> None:
    """Asserts that the value in every direction is within an absolute tolerance."""
    assert values.shape == (16,)
    torch.testing.assert_close(values.double(), torch.full((16,), expected).double(), atol=tolerance, rtol=0.0)


def around_the_limit(gentle: torch.Tensor, below: float = 1.0) -> torch.Tensor:
    """Slopes ``below`` degrees less than the limit in ``gentle`` directions, and a degree more in the others."""
    return torch.where(gentle, LIMIT - below, LIMIT + 1.0)


@GROUNDS
@pytest.mark.parametrize("command", [(0.0, 2.0), (0.5, 1.0)], ids=str)
def test_turns_at_the_rate_at_which_friction_balances(backend, ground, command) -> None:
    """All treads slip sideways in a turn; the yaw rate is that at which forces and moments of friction balance.

    It is 0.402 of the commanded rate: 0.804 rad/s for a command of 2 rad/s.
    """
    law = coulomb.steady_motion(get_robot("rover_zero"), center_of_mass()[0], *command).yaw
    assert law == pytest.approx(0.402 * command[1], rel=2e-3)
    assert_all_close(maneuvers.turning_rate(backend, ground, *command, seconds=1.0), law, tolerance=0.05 * law)


@HALVES
def test_climbs_slopes_up_to_the_friction_angle(backend, gentle) -> None:
    """Spinning wheels push uphill with ``mu m g cos s`` against ``m g sin s``: up to tan s = 0.5, s = 26.57 degrees."""
    assert pytest.approx(26.565, abs=1e-3) == LIMIT
    climbs = maneuvers.climbs(with_friction(backend, FRICTION), around_the_limit(gentle))
    assert torch.equal(climbs, gentle)


@HALVES
@pytest.mark.parametrize("turned", [0.0, math.pi / 2], ids=["facing up", "across"])
def test_stands_on_slopes_up_to_the_friction_angle(backend, gentle, turned) -> None:
    """Held wheels carry ``mu m g cos s`` at most, in any direction, against ``m g sin s``: up to 26.57 degrees.

    Friction in Bullet is right in the mean over its steps, and weaker in some: close to the limit, rovers creep.
    """
    below = 3.5 if backend == "bullet" else 1.0
    stands = maneuvers.stands(with_friction(backend, FRICTION), around_the_limit(gentle, below), turned)
    assert torch.equal(stands, gentle)


@pytest.mark.parametrize("slope", [20.0])
def test_accelerates_uphill_with_what_friction_leaves(backend, slope) -> None:
    """With all wheels spinning, ``a = g (mu cos s - sin s)``: 3.13 m/s^2 on 10 degrees, 1.25 m/s^2 on 20 degrees.

    The error is relative to the part of friction, ``mu g cos s``.
    """
    law = coulomb.climbing_acceleration(FRICTION, slope)
    assert law == pytest.approx({10.0: 3.127, 20.0: 1.254}[slope], abs=1e-3)
    by_friction = FRICTION * coulomb.GRAVITY * math.cos(math.radians(slope))
    found = maneuvers.climbing_acceleration(with_friction(backend, FRICTION), slope)
    assert_all_close(found, law, tolerance=0.05 * by_friction)


def test_slides_down_sideways_with_what_friction_leaves(backend) -> None:
    """Across a slope of 35 degrees with locked wheels, ``a = g (sin s - mu cos s) = 1.61 m/s^2``.

    The error is relative to the part of friction, ``mu g cos s``.
    """
    law = coulomb.sliding_acceleration(FRICTION, 35.0)
    assert law == pytest.approx(1.609, abs=1e-3)
    by_friction = FRICTION * coulomb.GRAVITY * math.cos(math.radians(35.0))
    found = maneuvers.sliding_acceleration(with_friction(backend, FRICTION), 35.0)
    assert_all_close(found, law, tolerance=0.05 * by_friction)


def test_keeps_its_height_while_driving_across_a_slope(backend) -> None:
    """Rolling wheels carry no force along their direction, so that all of ``mu N`` holds them while tan s < mu."""
    drift = maneuvers.drift(with_friction(backend, FRICTION), 20.0, seconds=3.0)
    assert_all_close(drift, 0.0, tolerance=1.0)


@GROUNDS
@pytest.mark.parametrize("friction", [0.15, 0.3])
def test_brakes_by_friction_alone_with_locked_wheels(backend, ground, friction) -> None:
    """The distance is ``v^2 / (2 mu g)``: 0.34 m from 1 m/s for a coefficient of 0.15, and 0.17 m for 0.3."""
    distance, speed = maneuvers.braking(backend, ground, friction)
    assert_all_close(speed, 1.0, tolerance=0.05)
    law = coulomb.braking_distance(friction, 1.0)
    assert law == pytest.approx({0.15: 0.340, 0.3: 0.170}[friction], abs=1e-3)
    # A sliding wheel of MuJoCo catches now and then on the edges of a height field.
    tolerance = 0.07 if backend == "mujoco" and ground is LEVEL_MESH else 0.05
    assert_all_close(distance / speed**2, law, tolerance=tolerance * law)
