"""Runs that fail keep their last checkpoint."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch

from rover_rl.algos.config import TrainingConfig, with_settings
from rover_rl.algos.policy.checkpoint import Checkpoint
from tests.algos.train.runs import BOTH, PPO, before_updates, run, state_of
from tests.full_disk import largest_file


@BOTH
def test_a_diverging_training_keeps_its_last_good_checkpoint(
    config: TrainingConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def diverge(number: int, learner: Any, batch: object) -> None:
        if number == 3:
            critics = (value for name, value in learner.weights().items() if "critic" in name or "qvalue" in name)
            next(critics).data.fill_(torch.nan)

    before_updates(monkeypatch, config.algo, diverge)
    config = with_settings(config, checkpoint_minutes=1e-9)
    each = config.num_envs * config.algorithm.rollout_length * config.collection.action_repeat
    with pytest.raises(FloatingPointError) as failure:
        run(config, tmp_path)
    folder = tmp_path / f"{config.algo}-maze"
    text = str(failure.value)
    assert text.startswith(f"training diverged after {3 * each} steps, with NaN or infinity in ")
    assert f"the last good checkpoint is {folder}/checkpoint.pt, of {2 * each} steps" in text
    assert text.endswith(f"rover-rl train --resume {folder} --learning-rate 0.0003")
    assert Checkpoint.load(folder).steps == state_of(folder)["steps"] == 2 * each
    assert all(int(file.stem) <= 2 * each for file in (folder / "snapshots").glob("*"))
    monkeypatch.undo()
    assert run(config, tmp_path, folder, learning_rate=3e-4).steps == 256


def test_a_full_disk_ends_a_run_and_keeps_its_checkpoint(tmp_path: Path) -> None:
    folder = run(PPO, tmp_path, snapshots=0, total_steps=64).folder
    whole = {path.name: path.read_bytes() for path in folder.glob("*.pt")}
    with largest_file(7000), pytest.raises(OSError, match=f"File too large: '{folder}/"):
        run(PPO, tmp_path, folder, snapshots=0, total_steps=128)
    assert {path.name: path.read_bytes() for path in folder.glob("*.pt")} == whole
    assert not [path.name for path in folder.iterdir() if path.name.startswith(".")]
    assert run(PPO, tmp_path, folder, snapshots=0, total_steps=128).steps == 128


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"world": "mars"}, "unknown world 'mars'"),
        ({"num_envs": 0}, "num_envs"),
        ({"backend": "warp", "curriculum": "learnability"}, "curriculum chooses among the worlds of a range"),
        ({"backend": "warp", "device": "cuda:99"}, r"device='cuda:99' is not available: PyTorch .* finds cpu"),
    ],
)
def test_invalid_settings_raise_before_anything_is_written(
    settings: dict[str, Any], message: str, tmp_path: Path
) -> None:
    with pytest.raises(ValueError, match=message):
        run(PPO, tmp_path, **settings)
    assert not list(tmp_path.iterdir())
