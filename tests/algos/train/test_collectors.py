"""Data is collected in worker processes, and in one process as by TorchRL's collector, to the last bit."""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections.abc import Iterator
from multiprocessing.process import BaseProcess
from pathlib import Path

import pytest
import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.collectors import Collector

from rover_rl.algos.config import UNLIMITED_STEPS, TrainingConfig, with_settings
from rover_rl.algos.policy.checkpoint import Checkpoint
from rover_rl.algos.train.collectors import WorkerError, collect
from rover_rl.algos.train.env import make_training_env
from rover_rl.algos.train.ppo import PPOLearner
from rover_rl.algos.train.run import prepare
from tests.algos.train.runs import FIELD, GRU, LEARNABLE, LEARNERS, PPO, SAC, before_updates, progress_of, run, state_of


@pytest.fixture
def workers(quick_workers: None) -> Iterator[set[BaseProcess]]:
    """Processes that run before the test; afterwards there are no others."""
    before = set(multiprocessing.active_children())
    yield before
    assert not set(multiprocessing.active_children()) - before


@pytest.mark.slow
def test_a_crashed_worker_ends_the_run_with_a_checkpoint_and_its_output(
    workers: set[BaseProcess], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def kill(number: int, *_: object) -> None:
        if number == 8:
            worker = next(iter(set(multiprocessing.active_children()) - workers))
            assert worker.pid is not None
            os.kill(worker.pid, signal.SIGSEGV)

    before_updates(monkeypatch, "sac", kill)
    with pytest.raises(WorkerError, match=r"(?s)exit code -11.*Fatal Python error: Segmentation fault"):
        run(SAC, tmp_path, workers=2, total_steps=UNLIMITED_STEPS, name="dying")
    folder, progress = tmp_path / "dying", progress_of(tmp_path / "dying")
    assert 8 <= state_of(folder)["updates"] == len(progress["updates"])
    # Each batch holds two decisions of the two rovers of one worker, followed by half of the gradient steps.
    assert progress["steps"][:8] == list(range(16, 129, 16))
    assert progress["gradient_steps"][:8] == [0.0] * 5 + [1.0] * 3
    monkeypatch.undo()
    steps = Checkpoint.load(folder).steps + 32
    assert run(SAC, tmp_path, folder, workers=1, total_steps=steps, name="dying").steps == steps


@pytest.mark.slow
def test_workers_get_the_spread_of_actions_that_training_has_reached(workers: set[BaseProcess]) -> None:
    config = prepare(with_settings(PPO, world=FIELD, workers=2, max_std=1.0, final_std=0.05))
    learner = PPOLearner(config)
    learner.schedule(0.0)
    with collect(config, learner.actor) as batches:
        assert 0.4 < next(batches)["scale"].max() < 1
        learner.schedule(1.0)
        assert next(batches)["scale"].max() <= 0.05
        learner.schedule(0.5)
        assert 0.2 < next(batches)["scale"].max() < 0.525


# --- one process

CONFIGS = {"curriculum": LEARNABLE, "gru": GRU}


@pytest.mark.parametrize("config", CONFIGS.values(), ids=CONFIGS)
def test_batches_are_those_of_a_collector(config: TrainingConfig) -> None:
    config = prepare(config)
    with collect(config, LEARNERS[config.algo](config).actor) as batches:
        own = [next(batches) for _ in range(3)]
    others = _batches_of_a_collector(config)
    assert any(batch["next", "done"][:, :-1].any() for batch in own)
    for batch, other in zip(own, others, strict=True):
        assert batch.shape == (config.num_envs, config.algorithm.rollout_length)
        assert _entries(batch).keys() == _entries(other).keys()
        for key, value in _entries(batch).items():
            assert torch.equal(value, _entries(other)[key]), key


def _batches_of_a_collector(config: TrainingConfig) -> list[TensorDictBase]:
    config = prepare(config)
    actor = LEARNERS[config.algo](config).actor
    collector = Collector(
        make_training_env(config),
        actor,
        frames_per_batch=config.num_envs * config.algorithm.rollout_length,
        track_traj_ids=False,
        auto_register_policy_transforms=False,
    )
    batches = iter(collector)
    try:
        return [next(batches) for _ in range(3)]
    finally:
        collector.shutdown()


def _entries(batch: TensorDictBase) -> dict[str, Tensor]:
    """All entries except for the times."""
    return {str(key): value for key, value in batch.items(True, True) if "clock" not in key}
