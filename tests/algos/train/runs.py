"""Small trainings for tests."""

from __future__ import annotations

import csv
from collections.abc import Callable
from itertools import count
from pathlib import Path
from typing import Any

import pytest
import torch
from tensordict import TensorDictBase

from rover_rl.algos.config import TrainingConfig, training_config, with_settings
from rover_rl.algos.policy.recurrent import MEMORY
from rover_rl.algos.train import train
from rover_rl.algos.train.ppo import PPOLearner
from rover_rl.algos.train.progress import read_progress
from rover_rl.algos.train.run import TrainingSummary
from rover_rl.algos.train.run_folder import load_state
from rover_rl.algos.train.sac import SACLearner
from rover_rl.worlds import Terrain, World, box

FIELD, WALL = f"{__name__}:field", f"{__name__}:wall"
"""Worlds that are quick to prepare and to simulate."""
SMALL: dict[str, Any] = {
    **{"world": "maze", "backend": "warp", "total_steps": 256, "num_envs": 4, "workers": 1},
    **{"minibatch": 8, "hidden": (16,), "snapshots": 2},
}
PPO = training_config("ppo", **SMALL, rollout_length=4, epochs=2)
SAC = training_config("sac", **SMALL, rollout_length=2, gradient_steps=2, learning_starts=24, buffer_size=32)
LEARNABLE = with_settings(PPO, backend="warp", world="maze:0-7@0-1", curriculum="learnability", length=24)
"""A training with a curriculum."""
GRU = with_settings(PPO, world=FIELD, memory="gru", memory_size=8, length=40, rollout_length=8, minibatch=16)
RECURRENT = with_settings(LEARNABLE, memory="gru", memory_size=8, rollout_length=8, minibatch=16)
"""A training of a policy with memory, with a curriculum."""
BOTH = pytest.mark.parametrize("config", [PPO, SAC], ids=["ppo", "sac"])
"""Runs a test with PPO and with SAC."""
LEARNERS: dict[str, Any] = {"ppo": PPOLearner, "sac": SACLearner}
"""Learners, by the algorithm's name."""


def field() -> World:
    return World("field", Terrain.flat((6.0, 6.0)))


def wall() -> World:
    return World("wall", Terrain.flat((6.0, 6.0)), [box((0.0, 0.0, 0.5), (0.2, 3.0, 1.0))])


def run(config: TrainingConfig, runs: Path, resumed: Path | None = None, **settings: Any) -> TrainingSummary:
    """Trains with other ``settings``, in the folder ``runs``."""
    return train(with_settings(config, runs=str(runs), **settings), resumed)


def progress_of(folder: Path) -> dict[str, list[float]]:
    """Columns of a run's ``progress.csv``, by name."""
    return read_progress(folder / "progress.csv")


def state_of(folder: Path) -> dict[str, Any]:
    """State from which a run continues."""
    return load_state(folder / "training_state.pt")


def equal(a: Any, b: Any) -> bool:
    """Whether two nested states are the same to the last bit."""
    if isinstance(a, torch.Tensor):
        return torch.equal(a, b)
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(equal(a[key], b[key]) for key in a)
    if isinstance(a, list | tuple):
        return len(a) == len(b) and all(map(equal, a, b))
    return a == b


def before_updates(monkeypatch: pytest.MonkeyPatch, algo: str, action: Callable[[int, Any, Any], object]) -> None:
    """Calls ``action(number, learner, batch)`` before each update of the learner. Numbers begin with 1."""
    learner, numbers = LEARNERS[algo], count(1)
    update = learner.update

    def watched(self: Any, batch: TensorDictBase, *rest: Any) -> dict[str, float]:
        action(next(numbers), self, batch)
        return update(self, batch, *rest)

    monkeypatch.setattr(learner, "update", watched)


def record_of(folder: Path) -> list[dict[str, str]]:
    """Rows of a run's ``curriculum.csv``."""
    with (folder / "curriculum.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def states_of(batch: TensorDictBase) -> TensorDictBase:
    """What :func:`check_states` reads of a batch."""
    return batch.select("is_init", MEMORY, "next").clone()


def check_states(batches: list[TensorDictBase]) -> TensorDictBase:
    """Checks that the memory moves, is cleared at resets row by row, and goes on; returns the batches as one."""
    batch = torch.cat(batches, 1)
    is_init = batch["is_init"].squeeze(-1)
    assert is_init[:, 0].all()
    assert 0 < is_init[:, 1:].sum() < is_init[:, 1:].numel() / 2
    assert torch.equal(is_init[:, 1:], batch["next", "done"].squeeze(-1)[:, :-1])
    state, after = batch[MEMORY], batch["next", MEMORY]
    assert (state[is_init] == 0).all()
    assert (after != 0).any(-1).all()
    going_on = ~is_init[:, 1:]
    assert torch.equal(state[:, 1:][going_on], after[:, :-1][going_on])
    return batch
