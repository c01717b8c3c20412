"""Actors with memory."""

from __future__ import annotations

import pytest
import torch
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import set_recurrent_mode

from rover_rl.algos.config import with_settings
from rover_rl.algos.policy.checkpoint import Checkpoint
from rover_rl.algos.policy.recurrent import MEMORY_KEYS, RecurrentStep, state_keys
from rover_rl.algos.policy.runner import PolicyRunner
from tests.algos.policy.memories import BOTH, observations, recurrent_checkpoint


@BOTH
@torch.no_grad()
def test_a_sequence_and_a_step_of_plain_tensors_give_the_same_as_the_actor(memory: str) -> None:
    checkpoint = recurrent_checkpoint(memory)
    actor, steps = checkpoint.make_actor(), observations(3)
    is_init = torch.zeros(3, len(steps), 1, dtype=torch.bool)
    is_init[:, 0] = is_init[1, 5] = is_init[2, 7] = True
    step, runner, actions = RecurrentStep(actor[0]), PolicyRunner(actor, action_repeat=1), []
    assert step.state_size == {"gru": 12, "lstm": 24}[memory]
    state, scale = torch.zeros(3, step.state_size), actor.spec["action"].space.high
    for seen, reset in zip(steps, is_init.unbind(1), strict=True):
        runner.reset(reset[:, 0])
        actions.append(runner(seen))
        entries = (seen[key] for key in checkpoint.config.network.observation)
        loc, state = step(state.masked_fill(reset, 0.0), *entries)
        torch.testing.assert_close(actions[-1], scale * loc.tanh())
    sequence = torch.stack([*steps], 1).set("is_init", is_init)
    with set_recurrent_mode(True):
        together = actor(sequence)
    torch.testing.assert_close(together["action"], torch.stack(actions, 1))
    assert [*together["next"].keys()] == [*MEMORY_KEYS[memory]] == state_keys(actor)


@BOTH
def test_a_checkpoint_restores_the_memory(memory: str, tmp_path) -> None:
    checkpoint = recurrent_checkpoint(memory)
    checkpoint.save(tmp_path / "checkpoint.pt")
    loaded = Checkpoint.load(tmp_path)
    assert loaded.config == checkpoint.config
    (seen, *_) = observations(2)
    first, second = (PolicyRunner(each.make_actor())(seen) for each in (checkpoint, loaded))
    assert torch.equal(first, second)
    other = Checkpoint(with_settings(loaded.config, memory_size=4), 0, loaded.actor)
    with pytest.raises(ValueError, match=rf"do not fit hidden=\(16, 8\), memory='{memory}' of 4 units"):
        other.make_actor()


@BOTH
def test_exploration_changes_the_action_and_not_the_memory(memory: str) -> None:
    actor = recurrent_checkpoint(memory).make_actor()
    seen = observations(2)[0].set("is_init", torch.ones(2, 1, dtype=torch.bool))
    with set_exploration_type(ExplorationType.RANDOM):
        first, second = actor(seen.clone()), actor(seen.clone())
    assert not torch.equal(first["action"], second["action"])
    for key in MEMORY_KEYS[memory]:
        assert torch.equal(first["next", key], second["next", key])
