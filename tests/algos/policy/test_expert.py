from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from rover_rl import RoverEnv, Terrain, World, box, make_env
from rover_rl.algos.policy.expert import MapExpert, PrivilegedExpert
from rover_rl.algos.policy.runner import PolicyRunner
from rover_rl.envs.transforms.path_reward import CAUTION
from rover_rl.robots import get_robot
from rover_rl.sims.free_space.paths import PathDistances

ROVER = get_robot("rover_zero")
POCKET = World(
    "pocket",
    Terrain.flat((12, 12)),
    [box((1.5, 0, 0.5), (0.4, 5, 1)), box((0, 2.3, 0.5), (3, 0.4, 1)), box((0, -2.3, 0.5), (3, 0.4, 1))],
)
"""Open to the left, closed to the right."""


def drive(world: World, steps: int, start: Tensor | None = None, goal: Tensor | None = None, **options):
    """Yields the observation before each step of rovers that follow the expert, and which have reached their goals."""
    env = make_env(world_n=world, seed=0, **options)
    expert = PrivilegedExpert([world], ROVER)
    places = {} if start is None else {"start": start, "goal": goal.expand(len(start), -1)}
    td, reached = env.reset(**places), torch.zeros(options["num_envs"], 1, dtype=torch.bool)
    for _ in range(steps):
        yield td, reached
        td = env.step(td.set("action", expert.action(td)))["next"]
        reached = reached | td["outcome", "goal_reached"]
        if reached.all():
            break
    yield td, reached


def test_it_leads_out_of_a_pocket_that_the_goal_lies_behind() -> None:
    distance, goal = PathDistances([POCKET], ROVER, caution=CAUTION), torch.tensor([[3.5, 0.0]])
    driven = [*drive(POCKET, 400, torch.tensor([[0.0, 0.3, 0.0]]), goal, num_envs=1)]
    row = torch.zeros(1, 1, dtype=torch.int64)
    left = torch.cat([distance(row, td["pose"][:, :2], goal) for td, _ in driven[:-1]])
    assert driven[-1][1].all()
    # Some 10 m, and some of them right beside a wall.
    assert 8 < left[0] < 15
    assert left[-1] < 1.5
    assert (left.diff(dim=0) < 0.3).all()


def test_its_actions_lie_within_the_contracts_bounds() -> None:
    env = make_env(world_n="maze", num_envs=64, seed=0)
    action = PrivilegedExpert(env.base_env.pool, ROVER).action(env.reset())
    assert action.shape == (64, 2)
    assert (action.abs() <= torch.tensor([1.0, math.pi])).all()


def test_it_passes_a_gap_in_which_it_cannot_turn() -> None:
    gap = World(
        "gap",
        Terrain.flat((8, 8)),
        [box((0, side * 2.37, 0.5), (0.2, 4, 1)) for side in (-1, 1)],
        spawn_range=((-3, -2), (-1, 1)),
        goal_range=((2, 3), (-1, 1)),
    )
    *_, (_, reached) = drive(gap, 500, num_envs=4, backend="warp", end_on_goal=True)
    assert reached.all()


def test_it_backs_down_a_slope() -> None:
    """While a rover turns around on a slope, it slides."""
    x = torch.arange(-6, 6.25, 0.25)
    slope = World("slope", Terrain((x * math.tan(math.radians(20))).expand(len(x), -1), 0.25))
    uphill = torch.tensor([[0.0, side, 0.3 * side] for side in (-1, -0.5, 0.5, 1)])
    options = {"num_envs": 4, "backend": "warp", "end_on_goal": True}
    for td, reached in drive(slope, 200, uphill, torch.tensor([[-3.0, 0.0]]), **options):
        # A reset after the goal is another episode.
        assert (td["imu"][:, 2:][~reached].abs() < 1).all()
    assert reached.all()


@pytest.mark.slow
def test_as_a_policy_it_reaches_goals_in_the_worlds_of_the_environment() -> None:
    with pytest.raises(RuntimeError, match="knows no map"):
        MapExpert()(make_env(world_n="maze", num_envs=1, backend="warp").reset())
    env = RoverEnv(world_n="maze:9000-9007", num_envs=8, seed=0, backend="warp", end_on_goal=True)
    runner, observation = PolicyRunner(MapExpert(), env=env), env.reset()
    reached = torch.zeros(8, dtype=torch.bool)
    for _ in range(600):
        observation = env.step(observation.set("action", runner(observation)).set("_step", ~reached))["next"]
        reached |= observation["outcome", "goal_reached"].squeeze(-1)
        if reached.all():
            break
    assert reached.all()
