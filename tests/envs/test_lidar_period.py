"""Lidars that scan every few steps."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from rover_rl import RoverEnv
from rover_rl.envs.config import LidarConfig, Randomization, TaskConfig
from tests.extras import needs_mujoco

BACKENDS = ["bullet", "warp", pytest.param("mujoco", marks=needs_mujoco)]
STEPS = 13


def make(backend: str, period: int, **options) -> RoverEnv:
    task = TaskConfig(collision_from="contact")
    return RoverEnv(world_n="maze", num_envs=3, seed=5, backend=backend, task=task, lidar_period=period, **options)


def drive(env: RoverEnv, reset_at: int = -1) -> tuple[Tensor, Tensor, Tensor]:
    """Readings ``[STEPS, 3, 32]``, poses, and the steps of the episodes. Before a step, the second row is reset."""
    observation, rows = env.reset(), []
    for step in range(STEPS):
        if step == reset_at:
            observation = env.reset(observation.select("done").set("_reset", torch.tensor([[False], [True], [False]])))
        observation = env.step(observation.set("action", torch.tensor([[0.6, 0.4]] * 3)))["next"]
        rows.append((observation["lidar"], observation["pose"], observation["outcome", "steps"].squeeze(-1)))
    lidar, pose, steps = (torch.stack(column) for column in zip(*rows, strict=True))
    return lidar, pose, steps


@pytest.mark.parametrize("backend", BACKENDS)
def test_scans_are_those_of_a_lidar_that_scans_in_every_step(backend: str) -> None:
    (lidar, pose, steps), (every, same_pose, _) = (drive(make(backend, period), reset_at=6) for period in (4, 1))
    assert torch.equal(pose, same_pose)
    assert steps[:, 1].tolist() == [1, 2, 3, 4, 5, 6, 1, 2, 3, 4, 5, 6, 7], "each row counts its own steps"
    scanned = steps % 4 == 0
    assert torch.equal(lidar[scanned], every[scanned])
    held = ~scanned[1:] & (steps[1:] > 1)
    assert torch.equal(lidar[1:][held], lidar[:-1][held])
    assert not torch.equal(lidar[1:][held], every[1:][held])


def test_a_reset_scans() -> None:
    env, every = make("warp", 50), make("warp", 1)
    assert torch.equal(env.reset()["lidar"], every.reset()["lidar"])


def test_a_scan_keeps_its_noise() -> None:
    lidar, _, steps = drive(make("warp", 4, randomization=Randomization(range_noise=0.05, dropout=0.1)))
    held = steps[1:] % 4 != 0
    assert torch.equal(lidar[1:][held], lidar[:-1][held])
    assert (lidar[3] != lidar[2]).any()


def test_the_period_is_at_least_one_step() -> None:
    with pytest.raises(ValueError, match="period must be at least 1 .*got 0"):
        LidarConfig(period=0)
