"""Runs that fail keep their last checkpoint."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch

from rover_rl.algos.config import TrainingConfig, with_settings
from rover_rl.algos.policy.checkpoint import Checkpoint
from rover_rl.algos.train import train
from rover_rl.algos.train.progress import ProgressLog
from rover_rl.algos.train.run_folder import load_state
from tests.algos.train.runs import BOTH, LEARNERS, PPO
from tests.full_disk import largest_file


def diverging(learner: type, monkeypatch: pytest.MonkeyPatch, after: int) -> None:
    """Sets weights of the critic to NaN after ``after`` updates."""
    update, calls = learner.update, []  # type: ignore[attr-defined]

    def diverge(self: Any, *args: Any) -> dict[str, float]:
        calls.append(1)
        learned = update(self, *args)
        if len(calls) > after:
            next(value for name, value in self.weights().items() if "critic" in name or "qvalue" in name).data.fill_(
                torch.nan
            )
        return learned

    monkeypatch.setattr(learner, "update", diverge)


@BOTH
def test_a_diverging_training_keeps_its_last_good_checkpoint(
    config: TrainingConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = with_settings(config, runs=str(tmp_path), checkpoint_minutes=1e-9)
    diverging(LEARNERS[config.algo], monkeypatch, after=2)
    each = config.num_envs * config.algorithm.rollout_length * config.collection.action_repeat
    with pytest.raises(FloatingPointError) as failure:
        train(config)
    folder = tmp_path / f"{config.algo}-maze"
    text = str(failure.value)
    assert text.startswith(f"training diverged after {3 * each} steps, with NaN or infinity in ")
    assert f"the last good checkpoint is {folder}/checkpoint.pt, of {2 * each} steps" in text
    assert text.endswith(f"rover-rl train --resume {folder} --learning-rate 0.0003")
    assert Checkpoint.load(folder).steps == load_state(folder / "training_state.pt")["steps"] == 2 * each
    assert max(int(file.stem) for file in (folder / "snapshots").iterdir()) <= 2 * each if config is PPO else True
    monkeypatch.undo()
    assert train(with_settings(config, learning_rate=3e-4), folder).steps == 256


def test_a_training_that_diverges_before_its_first_checkpoint_raises(tmp_path: Path) -> None:
    # The NaN appears within the update, and its next gradient step fails.
    with pytest.raises(FloatingPointError, match="there is no checkpoint yet; begin a new run with a lower learning"):
        train(with_settings(PPO, learning_rate=1e30, runs=str(tmp_path)))
    assert not (tmp_path / "ppo-maze" / "checkpoint.pt").exists()


def test_a_full_disk_ends_a_run_and_keeps_its_checkpoint(tmp_path: Path) -> None:
    config = with_settings(PPO, runs=str(tmp_path), snapshots=0)
    folder = train(with_settings(config, total_steps=128)).folder
    whole = {path.name: path.read_bytes() for path in folder.glob("*.pt")}
    with largest_file(7000), pytest.raises(OSError, match=f"File too large: '{folder}/"):
        train(config, folder)
    assert {path.name: path.read_bytes() for path in folder.glob("*.pt")} == whole
    assert not [path.name for path in folder.iterdir() if path.name.startswith(".")]
    assert train(config, folder).steps == 256


@pytest.mark.parametrize("kind", [OSError, SystemExit])
def test_a_closed_output_ends_a_run_with_a_checkpoint(
    kind: type[BaseException], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def closed(self: ProgressLog, share: float) -> None:
        raise kind

    monkeypatch.setattr(ProgressLog, "show", closed)
    with pytest.raises(kind):
        train(with_settings(PPO, runs=str(tmp_path)))
    assert load_state(tmp_path / "ppo-maze" / "training_state.pt")["updates"] == 1


@BOTH
def test_invalid_settings_raise_before_anything_is_written(config: TrainingConfig, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="unknown world 'mars'"):
        train(with_settings(config, world="mars", runs=str(tmp_path)))
    with pytest.raises(ValueError, match="num_envs"):
        train(with_settings(config, num_envs=0, runs=str(tmp_path)))
    assert not list(tmp_path.iterdir())


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a CUDA device")
def test_a_missing_gpu_raises(tmp_path: Path) -> None:
    config = with_settings(PPO, backend="warp", device="cuda", runs=str(tmp_path))
    with pytest.raises(ValueError, match=r"device='cuda' is not available: PyTorch .* finds cpu$"):
        train(config)
    assert not list(tmp_path.iterdir())
