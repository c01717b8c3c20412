"""Distance fields with caution."""

from __future__ import annotations

import pytest
import torch

from rover_rl import Terrain, World, box
from rover_rl.sims.robots import get_robot
from rover_rl.sims.worlds import free_space
from rover_rl.sims.worlds.path_grid import CAUTION_DISTANCE, PathGrid

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
