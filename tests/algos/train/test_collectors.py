"""Worker processes that collect data."""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections.abc import Iterator
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

import pytest

from rover_rl.algos.config import UNLIMITED_STEPS, TrainingConfig, with_settings
from rover_rl.algos.policy.checkpoint import Checkpoint
from rover_rl.algos.train import train
from rover_rl.algos.train.collectors import WorkerError
from rover_rl.algos.train.run_folder import load_state
from tests.algos.train.runs import BOTH, LEARNERS, PPO, SAC, progress_of


@pytest.mark.slow
def test_two_workers_share_the_rovers(tmp_path: Path) -> None:
    # The only test whose workers start as those of a user: each with a new interpreter.
    summary = train(with_settings(PPO, workers=2, total_steps=128, runs=str(tmp_path)))
    assert progress_of(summary.folder)["steps"] == [64, 128]


@pytest.mark.slow
@pytest.mark.usefixtures("quick_workers")
def test_sac_learns_from_one_worker_while_the_other_collects(tmp_path: Path) -> None:
    progress = progress_of(train(with_settings(SAC, workers=2, runs=str(tmp_path))).folder)
    # Each batch holds two decisions of the two rovers of one worker, followed by half of the gradient steps.
    assert progress["steps"] == list(range(16, 257, 16))
    assert progress["gradient_steps"] == [0.0] * 5 + [1.0] * 11


@pytest.fixture
def workers(quick_workers: None) -> Iterator[set[BaseProcess]]:
    """Processes that run before the test; afterwards there are no others."""
    before = set(multiprocessing.active_children())
    yield before
    assert not set(multiprocessing.active_children()) - before


@BOTH
@pytest.mark.slow
def test_a_crashed_worker_ends_the_run_with_a_checkpoint_and_its_output(
    config: TrainingConfig, workers: set[BaseProcess], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    learner = LEARNERS[config.algo]
    update, calls = learner.update, []

    def killing(self: Any, *args: Any) -> dict[str, float]:
        calls.append(1)
        if len(calls) == 3:
            worker = next(iter(set(multiprocessing.active_children()) - workers))
            assert worker.pid is not None
            os.kill(worker.pid, signal.SIGSEGV)
        return update(self, *args)

    monkeypatch.setattr(learner, "update", killing)
    with pytest.raises(WorkerError, match=r"(?s)exit code -11.*Fatal Python error: Segmentation fault"):
        train(with_settings(config, workers=2, total_steps=UNLIMITED_STEPS, runs=str(tmp_path), name="dying"))
    folder = tmp_path / "dying"
    assert 3 <= load_state(folder / "training_state.pt")["updates"] == len(progress_of(folder)["updates"])
    monkeypatch.setattr(learner, "update", update)
    steps = Checkpoint.load(folder).steps
    again = train(with_settings(config, workers=2, total_steps=steps + 128, runs=str(tmp_path), name="dying"), folder)
    assert again.steps == steps + 128


@BOTH
@pytest.mark.slow
@pytest.mark.usefixtures("quick_workers")
def test_an_error_of_a_worker_is_reported(
    config: TrainingConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # The world is not checked before the workers start.
    monkeypatch.setattr("rover_rl.algos.train.run.check_world", lambda world: None)
    with pytest.raises((WorkerError, ValueError), match="unknown world 'mars'"):
        train(with_settings(config, world="mars", workers=2, runs=str(tmp_path)))
