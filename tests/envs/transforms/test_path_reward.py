from __future__ import annotations

import pytest
import torch
from torchrl.envs import EnvBase

from rover_rl import RoverEnv, Terrain, World, box, make_env
from rover_rl.envs.transforms.action_repeat import ActionRepeat
from rover_rl.envs.transforms.path_reward import PathReward

WALL = World("wall", Terrain.flat((10, 10)), [box((0, 0, 0.5), (0.4, 4, 1))])


def make(weight: float = 2.0, rows: int = 1) -> EnvBase:
    env = make_env(world_n=WALL, num_envs=rows, seed=0).append_transform(ActionRepeat(4))
    return env.append_transform(PathReward(env.base_env, weight))


@pytest.mark.parametrize(
    ("start", "goal", "expected"),
    [
        ((-3.0, 0.0, 0.0), (-3.0, 3.0), 3.0),
        # Around the wall's end at y = 2, with 0.35 m to spare for the rover.
        ((-1.0, 0.0, 0.0), (1.0, 0.0), 2 * ((2.42**2 + 0.38**2) ** 0.5) + 1.24),
    ],
)
def test_the_way_that_is_left_leads_around_walls(
    start: tuple[float, ...], goal: tuple[float, ...], expected: float
) -> None:
    td = make().reset(start=torch.tensor([start]), goal=torch.tensor([goal]))
    # Steps in eight directions are up to 8 % longer than the way, and those beside the wall cost more.
    assert td["path_length"].item() == pytest.approx(expected, rel=0.12)


def test_metres_gained_are_paid_for_and_lost_ones_cost() -> None:
    env, plain = make(weight=2.0, rows=2), make_env(world_n=WALL, num_envs=2, seed=0).append_transform(ActionRepeat(4))
    place = {
        "start": torch.tensor([[-3.0, -3.0, 1.571], [-3.0, 0.0, -1.571]]),
        "goal": torch.tensor([[-3.0, 3.0], [-3.0, 3.0]]),
    }
    td, twin = env.reset(**place), plain.reset(**place)
    first = td["path_length"].clone()
    total = torch.zeros(2, 1)
    for _ in range(8):
        td["action"] = twin["action"] = torch.tensor([[1.0, 0.0]] * 2)
        td, twin = env.step(td), plain.step(twin)
        total += td["next", "reward"] - twin["next", "reward"]
        td, twin = env.step_mdp(td), plain.step_mdp(twin)
    torch.testing.assert_close(total, 2 * (first - td["path_length"]), atol=1e-4, rtol=0)
    # In 1.6 s it drives some 1.5 m: towards the goal in the first row, away from it in the second.
    torch.testing.assert_close(total, torch.tensor([[3.0], [-3.0]]), atol=0.5, rtol=0)


def test_a_goal_that_moves_on_costs_nothing() -> None:
    env = make(weight=100.0)
    td = env.reset(start=torch.tensor([[-3.0, 0.0, 1.571]]), goal=torch.tensor([[-3.0, 1.0]]))
    for _ in range(8):
        td["action"] = torch.tensor([[1.0, 0.0]])
        td = env.step(td)
        if td["next", "outcome", "goals"].item():
            assert td["next", "reward"].item() < 110
            return
        td = env.step_mdp(td)
    pytest.fail("the goal was not reached")


def test_each_rovers_way_is_that_of_its_own_world() -> None:
    worlds = ["maze", WALL, "maze"]
    start, goal = torch.tensor([[-3.0, 0.0, 0.0]]), torch.tensor([[-3.0, 3.0]])
    mixed = RoverEnv(world_n=worlds, num_envs=3)
    mixed = mixed.append_transform(PathReward(mixed, 1.0))
    lengths = mixed.reset(start=start.expand(3, 3), goal=goal.expand(3, 2))["path_length"]
    for row, world in enumerate(worlds):
        alone = RoverEnv(world_n=world)
        alone = alone.append_transform(PathReward(alone, 1.0))
        assert torch.equal(lengths[row], alone.reset(start=start, goal=goal)["path_length"][0])
    assert lengths[0] != lengths[1]
