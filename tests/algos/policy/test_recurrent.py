"""Actors with memory."""

from __future__ import annotations

import pytest
import torch
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import set_recurrent_mode

from rover_rl.algos.config import with_settings
from rover_rl.algos.policy.checkpoint import Checkpoint
from rover_rl.algos.policy.recurrent import MEMORY, PlainRecurrent, state_keys
from rover_rl.algos.policy.runner import PolicyRunner
from rover_rl.envs.encoding import ObservationEncoder
from tests.algos.policy.memories import observations, recurrent_checkpoint


@torch.no_grad()
def test_a_sequence_and_a_step_of_plain_tensors_give_the_same_as_the_actor() -> None:
    checkpoint = recurrent_checkpoint()
    actor, steps = checkpoint.make_actor(), observations(3)
    is_init = torch.zeros(3, len(steps), 1, dtype=torch.bool)
    is_init[:, 0] = is_init[1, 5] = is_init[2, 7] = True
    step, runner, actions = PlainRecurrent(actor[0]), PolicyRunner(actor, action_repeat=1), []
    assert step.state_size == 12
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
    assert [*together["next"].keys()] == [MEMORY] == state_keys(actor)


def test_sequences_and_their_gradients_are_those_of_torchrl() -> None:
    actor, generator = recurrent_checkpoint().make_actor(), torch.Generator().manual_seed(0)
    sequence = torch.stack(observations(3), 1)
    steps = sequence.shape[1]
    sequence["is_init"] = torch.rand(3, steps, 1, generator=generator) < 0.2
    plain = PlainRecurrent(actor[0])
    # TorchRL expects zeros where an episode begins.
    state = torch.randn(3, plain.state_size, generator=generator) * ~sequence["is_init"][:, 0]
    sequence[MEMORY] = torch.zeros(3, steps, 1, 12)
    sequence[MEMORY][:, 0, 0] = state
    with set_recurrent_mode(True):
        expected = actor[0](sequence)
    encoder = ObservationEncoder()
    rows = sequence.transpose(0, 1).reshape(-1)
    *parameters, after = plain.sequence(encoder(*(rows[key] for key in encoder.keys)), rows["is_init"], state)
    loc, scale = (part.unflatten(0, (steps, 3)).transpose(0, 1) for part in parameters)
    torch.testing.assert_close((loc, scale), (expected["loc"], expected["scale"]))
    torch.testing.assert_close(after, expected["next", MEMORY][:, -1, 0])
    weights, pull = [*actor.parameters()], torch.randn(loc.shape, generator=generator)
    pairs = (loc + scale, expected["loc"] + expected["scale"])
    found, theirs = (torch.autograd.grad((pull * each).sum(), weights) for each in pairs)
    torch.testing.assert_close(found, theirs)


def test_a_checkpoint_restores_the_memory(tmp_path) -> None:
    checkpoint = recurrent_checkpoint()
    checkpoint.save(tmp_path / "checkpoint.pt")
    loaded = Checkpoint.load(tmp_path)
    assert loaded.config == checkpoint.config
    (seen, *_) = observations(2)
    first, second = (PolicyRunner(each.make_actor())(seen) for each in (checkpoint, loaded))
    assert torch.equal(first, second)
    other = Checkpoint(with_settings(loaded.config, memory_size=4), 0, loaded.actor)
    with pytest.raises(ValueError, match=r"do not fit hidden=\(16, 8\), memory='gru' of 4 units"):
        other.make_actor()


def test_exploration_changes_the_action_and_not_the_memory() -> None:
    actor = recurrent_checkpoint().make_actor()
    seen = observations(2)[0].set("is_init", torch.ones(2, 1, dtype=torch.bool))
    with set_exploration_type(ExplorationType.RANDOM):
        first, second = actor(seen.clone()), actor(seen.clone())
    assert not torch.equal(first["action"], second["action"])
    assert torch.equal(first["next", MEMORY], second["next", MEMORY])
