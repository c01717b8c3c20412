"""Distance fields with caution."""

from __future__ import annotations

import pytest
import torch

from rover_rl import Terrain, World, box
from rover_rl.robots import get_robot
from rover_rl.sims.free_space import free_space
from rover_rl.sims.free_space.path_grid import CAUTION_DISTANCE, PathGrid

ROVER = get_robot("rover_zero")
POCKET = World(
    "pocket",
    Terrain.flat((12, 12)),
    [box((1.5, 0, 0.5), (0.4, 5, 1)), box((0, 2.3, 0.5), (3, 0.4, 1)), box((0, -2.3, 0.5), (3, 0.4, 1))],
)
"""World with a pocket that is open on the left."""


@pytest.mark.parametrize("caution", [0.5, 4.0])
def test_caution_increases_only_the_cost_of_paths_along_walls(caution: float) -> None:
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
