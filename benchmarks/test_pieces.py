"""Microbenchmarks of the parts of a step with pytest-benchmark, for the detection of regressions.

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
    current = env.reset().set("action", action)
    benchmark(env.step, current)


def test_step_without_reward(benchmark, env: EnvBase) -> None:
    base = env.base_env
    current = base.reset().set("action", base.action_spec.rand())
    benchmark(base.step, current)


def test_reset_of_all_rovers(benchmark, env: EnvBase) -> None:
    benchmark(env.reset)


def test_simulator_step(benchmark, env: EnvBase) -> None:
    simulator = env.base_env.simulator
    benchmark(simulator.step, torch.rand(simulator.num_envs, 2))


def test_rewards(benchmark, env: EnvBase) -> None:
    current = env.reset().set("action", env.action_spec.rand())
    following = env.base_env.step(current)["next"]

    def rewards() -> None:
        # Each step writes to a new TensorDict, so the benchmark writes to a copy.
        env.transform._step(current, following.copy())

    benchmark(rewards)


@pytest.mark.parametrize("beams", [32, 128, 640])
def test_lidar_scan(benchmark, beams: int) -> None:
    lidar = Lidar(get_world(WORLD), get_robot("rover_zero"), np.arange(beams) * (2 * np.pi / beams))
    rovers = 64
    position = np.column_stack((np.random.default_rng(0).uniform(-5, 5, (rovers, 2)), np.full(rovers, 2.0)))
    benchmark(lidar.scan, position, np.broadcast_to(np.eye(3), (rovers, 3, 3)))
