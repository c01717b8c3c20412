"""The sensor ``visits``, and the penalty in training for going where the rover has been."""

from __future__ import annotations

import math

import pytest
import torch
from tensordict import TensorDictBase
from torch import Tensor

from rover_rl import RoverEnv
from rover_rl.envs.config import EnvConfig
from rover_rl.envs.sensors.visits import CELL, DIRECTIONS, Visits
from rover_rl.envs.transforms.path_reward import RevisitPenalty
from rover_rl.worlds import Terrain, World

FLAT = World("flat", Terrain.flat((40.0, 40.0)))
CENTER = (CELL / 2, CELL / 2)
"""Center of a cell, m."""
BEHIND = DIRECTIONS // 2


def made(rows: int, sensor: Visits | None = None, robot: str = "rover_zero") -> RoverEnv:
    sensors = [sensor or Visits()]
    return RoverEnv(EnvConfig(world=FLAT, num_envs=rows, backend="warp", sensors=sensors, robot=robot, seed=2))


def begun(env: RoverEnv, yaw: Tensor) -> TensorDictBase:
    start = torch.cat((torch.tensor([CENTER]).repeat(len(yaw), 1), yaw[:, None]), -1)
    return env.reset(start=start, goal=torch.tensor([[15.0, 15.0]]).repeat(len(yaw), 1))


def driven(env: RoverEnv, tensordict: TensorDictBase, speed: float, steps: int) -> TensorDictBase:
    for _ in range(steps):
        action = torch.tensor([[speed, 0.0]]).repeat(env.num_envs, 1)
        tensordict = env.step(tensordict.set("action", action))["next"]
    return tensordict


def places(visits: Tensor) -> tuple[Tensor, Tensor]:
    """Splits visits into those of the place of the rover ``[N]`` and those around it, by distance ``[N, 3, 16]``."""
    return visits[:, 0], visits[:, 1:].unflatten(-1, (-1, DIRECTIONS))


def test_a_rover_that_stands_has_been_here_alone() -> None:
    env = made(1)
    here, around = places(driven(env, begun(env, torch.zeros(1)), 0.0, 19)["visits"])
    torch.testing.assert_close(here, torch.tensor([1.0]), atol=0.02, rtol=0)
    assert around.max() < 0.1
    env.close()


def test_the_way_behind_is_told_whatever_the_heading() -> None:
    env = made(3)
    _, around = places(driven(env, begun(env, torch.tensor([0.0, 0.7, -2.0])), 1.0, 60)["visits"])
    # 1 m/s: 0.75 s in each cell, beyond the first meter.
    assert (around[:, 0, BEHIND] > 0.3).all()
    assert (around[:, 1, BEHIND] > 0.3).all()
    ahead = around[..., [0, 1, 2, 3, -1, -2, -3]]
    assert ahead[:, 1:].max() < 0.01
    env.close()


def test_a_new_goal_and_a_new_episode_begin_without_visits() -> None:
    env, one_step = made(2), 0.05 + 1e-4
    tensordict = driven(env, begun(env, torch.zeros(2)), 0.5, 40)
    assert (tensordict["visits"][:, 0] > 0.3).all()
    env.set_goal(torch.tensor([[15.0, 15.0], [-15.0, 15.0]]))
    kept, cleared = driven(env, tensordict, 0.0, 1)["visits"][:, 0].tolist()
    assert kept > 0.3
    assert cleared <= one_step
    assert (begun(env, torch.zeros(2))["visits"].sum(-1) <= one_step * 49).all()
    assert (begun(env, torch.zeros(2))["visits"][:, 0] <= one_step).all()
    env.close()


def test_a_row_is_alone_what_it_is_in_a_batch_and_a_period_holds_readings() -> None:
    sensor, yaw = Visits(period=4), torch.tensor([0.3, -1.0])
    together, alone = made(2, sensor), made(1, sensor)
    both, one = begun(together, yaw), begun(alone, yaw[:1])
    for step in range(1, 30):
        last = one["visits"]
        both, one = driven(together, both, 0.8, 1), driven(alone, one, 0.8, 1)
        assert torch.equal(both["visits"][:1], one["visits"])
        assert torch.equal(one["visits"], last) == (step % 4 > 0)
    together.close()
    alone.close()


def test_lengths_grow_with_the_robot() -> None:
    small, large = made(1), made(1, robot="husky")
    ways = [places(driven(env, begun(env, torch.zeros(1)), 0.5, 30)["visits"])[1] for env in (small, large)]
    # After 0.75 m, the larger robot is in its first cell still.
    assert ways[0][0, 0, BEHIND] > ways[1][0, 0, BEHIND]
    small.close()
    large.close()


def test_the_mirror_image_swaps_left_and_right() -> None:
    value = torch.arange(49.0)
    mirrored = Visits().mirror(value)
    assert torch.equal(Visits().mirror(mirrored), value)
    assert mirrored[:4].tolist() == [0, 1, 16, 15]
    assert mirrored[17:19].tolist() == [17, 32]


@pytest.mark.parametrize(("here", "penalty"), [(0.5, 0.0), (3.0, 0.4), (math.inf, 2.0)])
def test_the_penalty_is_for_more_than_passing_and_has_a_limit(here: float, penalty: float) -> None:
    transform, visits = RevisitPenalty(weight=1.0, seconds=0.2), torch.zeros(1, 49)
    visits[:, 0] = here
    env = made(1)
    following = env.reset().set("visits", visits).set("reward", torch.ones(1, 1))
    reward = transform._step(following, following)["reward"]
    torch.testing.assert_close(reward, torch.tensor([[1.0 - penalty]]))
    env.close()
