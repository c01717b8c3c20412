from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from rover_rl import Terrain, World, box, make_env
from rover_rl.algos.guide import Guide
from rover_rl.algos.routes import CAUTIOUS, distance_fields
from rover_rl.sims.robots import get_robot
from rover_rl.sims.worlds import free_space

ROVER = get_robot("rover_zero")
POCKET = World(
    "pocket",
    Terrain.flat((12, 12)),
    [box((1.5, 0, 0.5), (0.4, 5, 1)), box((0, 2.3, 0.5), (3, 0.4, 1)), box((0, -2.3, 0.5), (3, 0.4, 1))],
)
"""Open to the left, closed to the right."""


def rollout(start: list[float], goal: list[float], steps: int) -> tuple[Tensor, Tensor]:
    """Way left and goals reached after each step, of a rover that follows the guide."""
    env = make_env(world_n=POCKET, num_envs=1, seed=0)
    guide = Guide(POCKET, ROVER)
    td = env.reset(start=torch.tensor([start]), goal=torch.tensor([goal]))
    left, reached = [], []
    for _ in range(steps):
        left.append(guide.path_length(td))
        td = env.step(td.set("action", guide.action(td)))["next"]
        reached.append(td["outcome", "goal_reached"])
        if reached[-1].item():
            break
    return torch.cat(left), torch.cat(reached)


def test_it_leads_out_of_a_pocket_that_the_goal_lies_behind() -> None:
    left, reached = rollout([0.0, 0.3, 0.0], [3.5, 0.0], 400)
    assert reached[-1]
    # Some 10 m, and some of them right beside a wall.
    assert 8 < left[0] < 15
    assert left[-1] < 1.5
    assert (left.diff(dim=0) < 0.3).all()


def test_it_drives_straight_where_nothing_is_in_the_way() -> None:
    _, reached = rollout([-4.0, -3.0, math.pi / 2], [-4.0, 3.0], 130)
    assert reached[-1]


def test_its_actions_lie_within_the_contracts_bounds() -> None:
    env = make_env(world_n="maze", num_envs=64, seed=0)
    action = Guide(env.base_env.worlds[0], ROVER).action(env.reset())
    assert action.shape == (64, 2)
    assert (action.abs() <= torch.tensor([1.0, math.pi])).all()


@pytest.mark.parametrize("caution", [0.5, 4.0])
def test_caution_makes_ways_along_walls_longer_and_leaves_others(caution: float) -> None:
    goal = torch.tensor([[-5.0, -5.0]])
    plain, careful = (distance_fields(POCKET, ROVER, goal, value)[0] for value in (0.0, caution))
    passable = free_space(POCKET, ROVER).passable
    ratio = (careful / plain)[passable & (plain > CAUTIOUS)]
    assert ratio.min() >= 1 - 1e-5
    assert ratio.max() <= 1 + caution
    assert (careful > plain + 0.1).any()
