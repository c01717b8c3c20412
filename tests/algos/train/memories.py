"""Small trainings with memory for tests."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from tensordict import TensorDictBase

from rover_rl.algos.config import with_settings
from rover_rl.algos.policy.recurrent import MEMORY_KEYS
from rover_rl.algos.train.ppo import PPOLearner
from tests.algos.train.runs import FIELD, PPO

GRU = with_settings(PPO, world=FIELD, memory="gru", memory_size=8, length=40, rollout_length=8, minibatch=16)
LSTM = with_settings(GRU, memory="lstm")


def joined(parts: list[TensorDictBase]) -> TensorDictBase:
    return torch.cat(parts, 1)


def check_states(batch: TensorDictBase, memory: str) -> None:
    """Checks that the memory moves, is cleared at resets row by row, and follows from what was seen."""
    is_init = batch["is_init"].squeeze(-1)
    assert is_init[:, 0].all()
    assert 0 < is_init[:, 1:].sum() < is_init[:, 1:].numel() / 2
    assert torch.equal(is_init[:, 1:], batch["next", "done"].squeeze(-1)[:, :-1])
    for key in MEMORY_KEYS[memory]:
        state, after = batch[key], batch["next", key]
        assert (state[is_init] == 0).all()
        assert (after != 0).any(-1).all()
        going_on = ~is_init[:, 1:]
        assert torch.equal(state[:, 1:][going_on], after[:, :-1][going_on])


def kept_batches(monkeypatch: pytest.MonkeyPatch) -> list[TensorDictBase]:
    """Returns a list to which the learners of PPO add each batch, as far as it concerns the memory."""
    collected: list[TensorDictBase] = []
    update = PPOLearner.update

    def kept(self: PPOLearner, batch: TensorDictBase, *args: Any) -> dict[str, float]:
        keys = ("is_init", *MEMORY_KEYS[self.config.network.memory])
        collected.append(batch.select(*keys, "next").clone())
        return update(self, batch, *args)

    monkeypatch.setattr(PPOLearner, "update", kept)
    return collected
