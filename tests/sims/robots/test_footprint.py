"""Footprints of robots, and the discs that cover them."""

from __future__ import annotations

import numpy as np
import pytest

from rover_rl.sims.robots import get_robot
from rover_rl.sims.robots.footprint import covering_discs, footprint

ROVER = get_robot("rover_zero")


def test_the_footprint_of_rover_zero_is_the_rectangle_around_its_wheels():
    assert footprint(ROVER) == pytest.approx((-0.267, 0.2635, -0.225, 0.225))


def test_the_turning_circle_contains_the_footprint():
    outline = footprint(ROVER)
    assert np.hypot(outline.half_length, outline.half_width) <= ROVER.radius


@pytest.mark.parametrize("excess", [0.005, 0.02, 0.1])
def test_discs_cover_the_footprint(excess):
    centers, radius = covering_discs(ROVER, excess)
    outline = footprint(ROVER)
    x, y = np.meshgrid(np.linspace(outline.back, outline.front, 60), np.linspace(outline.right, outline.left, 60))
    away = np.hypot(x[..., None] - centers, y[..., None]).min(-1)
    assert away.max() <= radius + 1e-9
    assert outline.half_width < radius <= outline.half_width + excess + 1e-9
