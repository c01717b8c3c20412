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
EVERY_SECOND = torch.arange(16) % 2 == 0


def assert_all_close(values: torch.Tensor, expected: float, *, tolerance: float) -> None:
    assert values.shape == (16,)
    torch.testing.assert_close(values.double(), torch.full((16,), expected).double(), atol=tolerance, rtol=0.0)


def around_the_limit(gentle: torch.Tensor, below: float = 1.0) -> torch.Tensor:
    """Slopes ``below`` degrees less than the limit in ``gentle`` directions, and a degree more in the others."""
    return torch.where(gentle, LIMIT - below, LIMIT + 1.0)


@pytest.mark.parametrize(
    ("ground", "command"), [(maneuvers.PLANE, (0.0, 2.0)), (LEVEL_MESH, (0.5, 1.0))], ids=["on a plane", "on triangles"]
)
def test_turns_at_the_rate_at_which_friction_balances(backend, ground, command) -> None:
    """All treads slip sideways in a turn; the yaw rate is that at which forces and moments of friction balance.

    It is 0.402 of the commanded rate: 0.804 rad/s for a command of 2 rad/s.
    """
    law = coulomb.steady_motion(get_robot("rover_zero"), center_of_mass()[0], *command).yaw
    assert law == pytest.approx(0.402 * command[1], rel=2e-3)
    assert_all_close(maneuvers.turning_rate(backend, ground, *command, seconds=1.0), law, tolerance=0.05 * law)


@pytest.mark.parametrize("gentle", [EVERY_SECOND, ~EVERY_SECOND], ids=["even", "odd"])
def test_climbs_slopes_up_to_the_friction_angle(backend, gentle) -> None:
    """Spinning wheels push uphill with ``mu m g cos s`` against ``m g sin s``: up to tan s = 0.5, s = 26.57 degrees."""
    assert pytest.approx(26.565, abs=1e-3) == LIMIT
    climbs = maneuvers.climbs(with_friction(backend, FRICTION), around_the_limit(gentle))
    assert torch.equal(climbs, gentle)


@pytest.mark.parametrize(
    ("gentle", "turned"), [(EVERY_SECOND, 0.0), (~EVERY_SECOND, math.pi / 2)], ids=["facing up", "across"]
)
def test_stands_on_slopes_up_to_the_friction_angle(backend, gentle, turned) -> None:
    """Held wheels carry ``mu m g cos s`` at most, in any direction, against ``m g sin s``: up to 26.57 degrees.

    Friction in Bullet is right in the mean over its steps, and weaker in some: close to the limit, rovers creep.
    """
    below = 3.5 if backend == "bullet" else 1.0
    stands = maneuvers.stands(with_friction(backend, FRICTION), around_the_limit(gentle, below), turned)
    assert torch.equal(stands, gentle)


@pytest.mark.parametrize(("motion", "slope", "expected"), [("climbing", 20.0, 1.254), ("sliding", 35.0, 1.609)])
def test_accelerates_on_a_slope_with_what_friction_leaves(backend, motion, slope, expected) -> None:
    """Up with all wheels spinning, ``a = g (mu cos s - sin s)``, and down with locked wheels across the slope.

    The error is relative to the part of friction, ``mu g cos s``.
    """
    law, found = (getattr(module, f"{motion}_acceleration") for module in (coulomb, maneuvers))
    assert law(FRICTION, slope) == pytest.approx(expected, abs=1e-3)
    by_friction = FRICTION * coulomb.GRAVITY * math.cos(math.radians(slope))
    assert_all_close(found(with_friction(backend, FRICTION), slope), expected, tolerance=0.05 * by_friction)


def test_keeps_its_height_while_driving_across_a_slope(backend) -> None:
    """Rolling wheels carry no force along their direction, so that all of ``mu N`` holds them while tan s < mu."""
    drift = maneuvers.drift(with_friction(backend, FRICTION), 20.0, seconds=3.0)
    assert_all_close(drift, 0.0, tolerance=1.0)


@pytest.mark.parametrize(
    ("ground", "friction"), [(maneuvers.PLANE, 0.3), (LEVEL_MESH, 0.15)], ids=["on a plane", "on triangles"]
)
def test_brakes_by_friction_alone_with_locked_wheels(backend, ground, friction) -> None:
    """The distance is ``v^2 / (2 mu g)``: 0.34 m from 1 m/s for a coefficient of 0.15, and 0.17 m for 0.3."""
    distance, speed = maneuvers.braking(backend, ground, friction)
    assert_all_close(speed, 1.0, tolerance=0.05)
    law = coulomb.braking_distance(friction, 1.0)
    assert law == pytest.approx({0.15: 0.340, 0.3: 0.170}[friction], abs=1e-3)
    # A sliding wheel of MuJoCo catches now and then on the edges of a height field.
    tolerance = 0.07 if backend == "mujoco" and ground is LEVEL_MESH else 0.05
    assert_all_close(distance / speed**2, law, tolerance=tolerance * law)
