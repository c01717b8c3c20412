"""Episode endings on Bullet."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
import pytest
from tensordict import TensorDict

from rover_rl import RewardConfig, TaskConfig, World, make_env
from rover_rl.envs.task import StepEvent
from rover_rl.worlds import Terrain
from tests.envs import transcription as contract
from tests.envs.contract.scripted_env import flat_world, pairs, step_events


def drive(world: World, start: tuple, action: tuple, steps: int, **settings) -> list[TensorDict]:
    """Results of each step of one rover, up to and including the end of its episode."""
    env = make_env(world_n=world, lidar_beams=32, seed=0, **settings)
    td = env.reset(start=pairs(start), goal=pairs((50.0, 50.0)))
    results = []
    for _ in range(steps):
        td["action"] = pairs(action)
        td = env.step(td)["next"]
        results.append(td)
        if td["done"].any():
            break
    env.close()
    return results


def test_a_rover_that_stands_still_is_stuck():
    results = drive(flat_world(), (0.0, 0.0, 0.0), (0.0, 0.0), 40, task=TaskConfig(stuck_window=30))
    assert (len(results), step_events(results)[-1], results[-1]["reward"].item()) == (30, StepEvent.STUCK, -25.0)


@lru_cache
def cliff() -> World:
    """Ground 2 m high with an edge just before x = 0."""
    heights = np.zeros((25, 25))
    heights[:, :12] = 2.0
    return World("cliff", Terrain(heights, 0.25), spawn_range=((-2.5, -1.5), (-1.0, 1.0)))


@pytest.mark.parametrize(("grace", "reward"), [(500, 0.0), (1, -20.0)])
def test_a_rover_that_falls_over_the_edge_of_a_cliff_flips(grace, reward):
    config = RewardConfig(flip_grace_steps=grace)
    results = drive(cliff(), (-0.25, 0.0, math.pi / 2), (0.5, 0.0), 40, reward=config)
    assert len(results) > 1
    assert step_events(results)[-1] == StepEvent.FLIP
    assert results[-1]["reward"].item() == reward
    pitch, roll, _ = results[-1]["imu"][0].tolist()
    assert contract.is_flipped(roll, pitch)
