"""The expert that knows the map."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from rover_rl import Terrain, World, box, make_env
from rover_rl.algos.policy.expert import CAUTION, MapExpert, PrivilegedExpert
from rover_rl.robots import get_robot
from rover_rl.sims.free_space.paths import PathDistances
from tests.algos.policy.crossings import reached

ROVER = get_robot("rover_zero")


def drive(world: World, steps: int, start: Tensor | None = None, goal: Tensor | None = None, num_envs: int = 4):
    """Yields the observation before each step of rovers that follow the expert, and which have reached their goals."""
    env = make_env(world_n=world, seed=0, num_envs=num_envs, backend="warp", end_on_goal=True)
    expert = PrivilegedExpert([world], ROVER)
    places = {} if start is None else {"start": start, "goal": goal.expand(len(start), -1)}
    td, arrived = env.reset(**places), torch.zeros(num_envs, 1, dtype=torch.bool)
    for _ in range(steps):
        yield td, arrived
        action = expert.action(td)
        assert (action.abs() <= torch.tensor([1.0, math.pi])).all()
        td = env.step(td.set("action", action))["next"]
        arrived = arrived | td["outcome", "goal_reached"]
        if arrived.all():
            break
    yield td, arrived


def test_it_leads_out_of_a_pocket_that_the_goal_lies_behind() -> None:
    walls = [box((1.5, 0, 0.5), (0.4, 5, 1)), *(box((0, y, 0.5), (3, 0.4, 1)) for y in (2.3, -2.3))]
    pocket = World("pocket", Terrain.flat((12, 12)), walls)
    distance, goal = PathDistances([pocket], ROVER, caution=CAUTION), torch.tensor([[3.5, 0.0]])
    driven = [*drive(pocket, 400, torch.tensor([[0.0, 0.3, 0.0]]), goal, num_envs=1)]
    row = torch.zeros(1, 1, dtype=torch.int64)
    left = torch.cat([distance(row, td["pose"][:, :2], goal) for td, _ in driven[:-1]])
    assert driven[-1][1].all()
    # Some 10 m, and some of them right beside a wall.
    assert 8 < left[0] < 15
    assert left[-1] < 1.5
    assert (left.diff(dim=0) < 0.3).all()


def test_it_passes_a_gap_in_which_it_cannot_turn() -> None:
    gap = World(
        "gap",
        Terrain.flat((8, 8)),
        [box((0, side * 2.37, 0.5), (0.2, 4, 1)) for side in (-1, 1)],
        spawn_range=((-3, -2), (-1, 1)),
        goal_range=((2, 3), (-1, 1)),
    )
    *_, (_, arrived) = drive(gap, 500)
    assert arrived.all()


def test_it_backs_down_a_slope() -> None:
    """While a rover turns around on a slope, it slides."""
    x = torch.arange(-6, 6.25, 0.25)
    slope = World("slope", Terrain((x * math.tan(math.radians(20))).expand(len(x), -1), 0.25))
    uphill = torch.tensor([[0.0, side, 0.3 * side] for side in (-1, -0.5, 0.5, 1)])
    for td, arrived in drive(slope, 200, uphill, torch.tensor([[-3.0, 0.0]])):
        # A reset after the goal is another episode.
        assert (td["imu"][:, 2:][~arrived].abs() < 1).all()
    assert arrived.all()


@pytest.mark.slow
def test_as_a_policy_it_reaches_goals_in_the_worlds_of_the_environment() -> None:
    with pytest.raises(RuntimeError, match="knows no map"):
        MapExpert()(make_env(world_n="maze", num_envs=1, backend="warp").reset())
    assert reached(MapExpert(), "maze:9000-9003", 4) == 4
