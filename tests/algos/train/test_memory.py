"""Policies with memory are trained on sequences."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import pytest
import torch
from tensordict import TensorDictBase
from torchrl.modules import set_recurrent_mode

from rover_rl.algos.config import TrainingConfig, with_settings
from rover_rl.algos.evaluation.episodes import draw_episodes
from rover_rl.algos.evaluation.evaluate import evaluate
from rover_rl.algos.policy.checkpoint import Checkpoint
from rover_rl.algos.policy.networks import mirrored
from rover_rl.algos.policy.recurrent import PlainRecurrent
from rover_rl.algos.policy.runner import PolicyRunner
from rover_rl.algos.train.collectors import collect
from rover_rl.algos.train.ppo import MirrorMemory, PPOLearner
from rover_rl.algos.train.progress import Stopwatch
from rover_rl.algos.train.run import prepare
from rover_rl.envs.encoding import ObservationEncoder
from tests.algos.train.runs import FIELD, GRU, PPO, WALL, check_states, field, run

OBSERVATION = PPO.network.observation


@cache
def batches(config: TrainingConfig, count: int) -> tuple[PPOLearner, list[TensorDictBase]]:
    """Returns a learner and the first batches ``[4, 8]`` that it collects, without an update."""
    config = prepare(config)
    learner = PPOLearner(config)
    with collect(config, learner.actor) as collected:
        return learner, [next(collected).clone() for _ in range(count)]


@torch.no_grad()
def test_the_memory_moves_in_collected_data_and_is_cleared_at_resets() -> None:
    learner, collected = batches(GRU, 3)
    batch = check_states(collected)
    # What was collected step by step follows from the whole sequence of observations, and nothing else.
    seen = batch.select(*OBSERVATION, "is_init")
    with set_recurrent_mode(True):
        again = learner.actor[0](seen)
    for key in ("loc", "scale"):
        torch.testing.assert_close(again[key], batch[key])


def test_the_first_gradient_step_finds_the_probabilities_of_the_collected_actions() -> None:
    settings = with_settings(GRU, mirror_augmentation=False, epochs=1, minibatch=32)
    learner, collected = batches(settings, 2)
    logged = learner.update(collected[1], 0.0, Stopwatch())
    assert logged["gradient_steps"] == 1
    assert logged["kl_approx"] == pytest.approx(0.0, abs=1e-6)
    assert logged["clip_fraction"] == 0.0


@torch.no_grad()
def test_mirror_images_have_the_memory_of_one_that_saw_them_from_the_start() -> None:
    learner, collected = batches(GRU, 3)
    memory, encoder = PlainRecurrent(learner.actor[0]), ObservationEncoder(OBSERVATION)
    mirrors, runner = MirrorMemory(memory), PolicyRunner(learner.actor, action_repeat=1)
    image = mirrored(torch.cat(collected[:2], 1).select(*OBSERVATION, "is_init"), torch.ones(4, 16, dtype=torch.bool))
    means = []
    for step in image.unbind(1):
        runner.reset(step["is_init"].squeeze(-1))
        runner(step.select(*OBSERVATION))
        assert runner.distribution is not None
        means.append(runner.distribution[0])
    for part, batch in enumerate(image.split(8, 1)):
        features = encoder(*(batch[key] for key in OBSERVATION))
        state, rows = mirrors.starts(features, batch["is_init"]), batch["is_init"].transpose(0, 1).flatten(0, 1)
        loc, _, _ = memory.sequence(features.transpose(0, 1).flatten(0, 1), rows, state)
        torch.testing.assert_close(loc, torch.cat(means[8 * part : 8 * part + 8]))


def test_a_privileged_critic_learns(tmp_path: Path) -> None:
    config = with_settings(GRU, privileged_critic=True, world=(FIELD, WALL))
    learner, (batch, *_) = batches(config, 1)
    assert not any(key[0] == "privileged" for key in learner.actor.in_keys if isinstance(key, tuple))
    assert "privileged" not in learner.actor.in_keys
    value = learner.critic(batch.clone())["state_value"]
    changed = batch.clone()
    for part in changed["privileged"].values():
        part += 1.0
    assert not torch.isclose(learner.critic(changed.clone())["state_value"], value).any()
    with set_recurrent_mode(True):
        first, second = (learner.actor(each)["loc"] for each in (batch.clone(), changed.clone()))
    assert torch.equal(first, second)
    before = {name: weight.clone() for name, weight in learner.weights().items()}
    learner.update(batch, 0.0, Stopwatch())
    assert all(not torch.equal(weight, before[name]) for name, weight in learner.weights().items())
    summary = run(config, tmp_path, total_steps=128)
    # Whoever drives the policy needs no privileged observation.
    actor = Checkpoint.load(summary.folder).make_actor()
    assert len(evaluate(actor, draw_episodes(field(), 1, 0), seconds=1).endings) == 1
