"""The small pieces of a step, each by itself, with pytest-benchmark: what a regression shows in.

pytest benchmarks/test_pieces.py --benchmark-autosave
pytest benchmarks/test_pieces.py --benchmark-compare --benchmark-compare-fail=median:25%
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
import torch
from torchrl.envs import EnvBase

from rover_rl import make_env
from rover_rl.sims.bullet.lidar import Lidar
from rover_rl.sims.robots import get_robot
from rover_rl.sims.worlds import get_world

WORLD = "inspect"
torch.set_num_threads(1)


@pytest.fixture(params=[1, 64], ids=lambda count: f"{count} rovers")
def env(request: pytest.FixtureRequest) -> Iterator[EnvBase]:
    env = make_env(world_n=WORLD, num_envs=request.param, seed=0)
    env.reset()
    yield env
    env.close()


def test_step_with_reward(benchmark, env: EnvBase) -> None:
    action = env.action_spec.rand()
    now = env.reset().set("action", action)
    benchmark(env.step, now)


def test_step_of_the_bare_task(benchmark, env: EnvBase) -> None:
    bare = env.base_env
    now = bare.reset().set("action", bare.action_spec.rand())
    benchmark(bare.step, now)


def test_reset_of_all_rovers(benchmark, env: EnvBase) -> None:
    benchmark(env.reset)


def test_simulator_step(benchmark, env: EnvBase) -> None:
    simulator = env.base_env.simulator
    benchmark(simulator.step, torch.rand(simulator.num_envs, 2))


def test_rewards(benchmark, env: EnvBase) -> None:
    now = env.reset().set("action", env.action_spec.rand())
    after = env.base_env.step(now)["next"]

    def rewards() -> None:
        # Into a copy, as each step has one of its own.
        env.transform._step(now, after.copy())

    benchmark(rewards)


@pytest.mark.parametrize("beams", [32, 128, 640])
def test_lidar_scan(benchmark, beams: int) -> None:
    lidar = Lidar(get_world(WORLD), get_robot("rover_zero"), np.arange(beams) * (2 * np.pi / beams))
    rovers = 64
    position = np.column_stack((np.random.default_rng(0).uniform(-5, 5, (rovers, 2)), np.full(rovers, 2.0)))
    benchmark(lidar.scan, position, np.broadcast_to(np.eye(3), (rovers, 3, 3)))
