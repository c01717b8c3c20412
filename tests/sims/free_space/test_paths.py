"""Shortest paths, and distance fields with caution."""

from __future__ import annotations

import math
from itertools import pairwise

import pytest
import torch

from rover_rl import Terrain, World, box
from rover_rl.robots import get_robot
from rover_rl.sims.free_space import free_space
from rover_rl.sims.free_space.paths import CAUTION_DISTANCE, PathGrid, shortest_paths

ROVER = get_robot("rover_zero")
POCKET = World(
    "pocket",
    Terrain.flat((12, 12)),
    [box((1.5, 0, 0.5), (0.4, 5, 1)), box((0, 2.3, 0.5), (3, 0.4, 1)), box((0, -2.3, 0.5), (3, 0.4, 1))],
)
"""World with a pocket that is open on the left."""


def test_caution_increases_only_the_cost_of_paths_along_walls() -> None:
    caution = 4.0
    goal = torch.tensor([[-5.0, -5.0]])
    plain, careful = (PathGrid(POCKET, ROVER, value).costs(goal)[0] for value in (0.0, caution))
    passable = free_space(POCKET, ROVER).passable
    ratio = (careful / plain)[passable & (plain > CAUTION_DISTANCE)]
    assert ratio.min() >= 1 - 1e-5
    assert ratio.max() <= 1 + caution
    assert (careful > plain + 0.1).any()


def test_caution_avoids_slopes() -> None:
    """Paths over a hill with slopes of up to 20 degrees, and past it."""
    x = torch.arange(-5, 5.1, 0.1, dtype=torch.float64)
    y, x = torch.meshgrid(x, x, indexing="ij")
    hill = World("hill", Terrain(0.9 * torch.exp(-(x**2 + y**2) / (2 * 1.5**2)), 0.1))
    grids = [PathGrid(hill, ROVER, caution) for caution in (0.0, 4.0)]
    for x_start, least, most in ((-4, -1e-3, 0.02), (0, 0.5, 2.5)):
        plain, careful = (grid.costs(torch.tensor([[x_start, -4.0]]))[0] for grid in grids)
        # From y = 4 to y = -4.
        extra = (careful - plain)[90, 50 + 10 * x_start]
        assert least < extra < most


def test_a_path_around_a_wall_is_as_long_as_a_string_around_its_corners() -> None:
    start, goal = torch.tensor([[0.5, 0.0], [-5.0, 0.0]]), torch.tensor([[5.0, 0.0], [-5.0, 0.3]])
    length, near = shortest_paths(POCKET, ROVER, start, goal, goal_radius=0.5).tolist()
    # Out of the pocket, whose walls are 3 m long, and around it, a robot's radius away from them.
    r = ROVER.radius
    corners = [(0.5, 0.0), (-1.5 - r, 2.1), (-1.5 - r, 2.5 + r), (1.7 + r, 2.5 + r)]
    bound = sum(math.dist(a, b) for a, b in pairwise(corners))
    bound += math.dist(corners[-1], (5.0, 0.0)) - 0.5
    assert near == 0
    assert length == pytest.approx(bound, rel=0.06)
    way = PathGrid(POCKET, ROVER).path(start[0], goal[0])
    assert way[[0, -1]].tolist() == [[0.5, 0.0], [5.0, 0.0]]
    assert free_space(POCKET, ROVER).contains(way).all()
