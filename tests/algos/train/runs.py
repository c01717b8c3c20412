"""Small trainings for tests."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch

from rover_rl.algos.config import training_config, with_settings
from rover_rl.algos.train.ppo import PPOLearner
from rover_rl.algos.train.progress import read_progress
from rover_rl.algos.train.sac import SACLearner
from rover_rl.sims.worlds import Terrain, World, box

PPO = training_config(
    "ppo",
    world="maze",
    backend="bullet",
    total_steps=256,
    num_envs=4,
    workers=1,
    rollout_length=4,
    epochs=2,
    minibatch=8,
    hidden=(16,),
    snapshots=2,
)
SAC = training_config(
    "sac",
    world="maze",
    backend="bullet",
    total_steps=256,
    num_envs=4,
    workers=1,
    rollout_length=2,
    gradient_steps=2,
    minibatch=8,
    learning_starts=24,
    buffer_size=32,
    hidden=(16,),
    snapshots=2,
)
LEARNABLE = with_settings(PPO, backend="warp", world="maze:0-7@0-1", curriculum="learnability", length=24)
"""A training with a curriculum."""
BOTH = pytest.mark.parametrize("config", [PPO, SAC], ids=["ppo", "sac"])
"""Runs a test with PPO and with SAC."""
LEARNERS: dict[str, Any] = {"ppo": PPOLearner, "sac": SACLearner}
"""Learners, by the algorithm's name."""


FIELD, WALL = f"{__name__}:field", f"{__name__}:wall"
"""Worlds that are quick to prepare and to simulate."""


def field() -> World:
    return World("field", Terrain.flat((6.0, 6.0)))


def wall() -> World:
    return World("wall", Terrain.flat((6.0, 6.0)), [box((0.0, 0.0, 0.5), (0.2, 3.0, 1.0))])


def progress_of(folder: Path) -> dict[str, list[float]]:
    """Columns of a run's ``progress.csv``, by name."""
    return read_progress(folder / "progress.csv")


def equal(a: Any, b: Any) -> bool:
    """Whether two nested states are the same to the last bit."""
    if isinstance(a, torch.Tensor):
        return torch.equal(a, b)
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(equal(a[key], b[key]) for key in a)
    if isinstance(a, list | tuple):
        return len(a) == len(b) and all(map(equal, a, b))
    return a == b
