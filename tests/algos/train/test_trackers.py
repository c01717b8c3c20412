from __future__ import annotations

import math
import re
from pathlib import Path

import pytest

from rover_rl.algos.config import training_config, with_settings
from rover_rl.algos.train import train
from rover_rl.algos.train.trackers import Trackers, check_trackers
from tests.algos.train.runs import PPO

CONFIG = training_config("ppo", gamma=0.9)


def track(folder: Path, *names: str, steps: tuple[int, ...] = (100,), resumed_at: int | None = None) -> list[str]:
    """Sends a row for each number of steps; returns what was said."""
    said: list[str] = []
    trackers = Trackers(names, folder, CONFIG, resumed_at, said.append)
    for number in steps:
        trackers.add({"steps": number, "goals": 1.5, "episode_return": math.nan})
    trackers.close()
    return said


def test_events_after_the_state_that_is_gone_on_from_are_hidden(tmp_path: Path) -> None:
    accumulator = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    track(tmp_path, "tensorboard", steps=(100, 200, 300))
    track(tmp_path, "tensorboard", steps=(200, 250), resumed_at=101)
    events = accumulator.EventAccumulator(str(tmp_path / "tensorboard")).Reload()
    assert [(event.step, event.value) for event in events.Scalars("goals")] == [(100, 1.5), (200, 1.5), (250, 1.5)]


def test_a_run_has_the_record_of_each_tracker(tmp_path: Path) -> None:
    pytest.importorskip("tensorboard")
    config = with_settings(PPO, world="inspect", logger=("csv", "tensorboard"), total_steps=64, runs=str(tmp_path))
    summary = train(config)
    rows = (summary.folder / "progress.csv").read_text().count("\n") - 1
    assert (summary.folder / "csv" / "scalars" / "loss_critic.csv").read_text().count("\n") == rows
    assert [*(summary.folder / "tensorboard").glob("events.*")]
    # A finished run that is continued has nothing more to tell.
    train(config, summary.folder)
    assert len([*(summary.folder / "tensorboard").glob("events.*")]) == 1


def test_missing_packages_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    check_trackers(["csv"])
    monkeypatch.setattr("rover_rl.algos.train.trackers.find_spec", lambda name: None)
    with pytest.raises(
        ImportError, match=re.escape('the tracker mlflow needs its package: pip install "rover_rl[mlflow]"')
    ):
        check_trackers(["mlflow"])


def test_a_tracker_that_fails_does_not_end_the_training(tmp_path: Path) -> None:
    said: list[str] = []
    trackers = Trackers(["csv"], tmp_path, CONFIG, None, said.append)
    (tmp_path / "csv" / "scalars").rmdir()
    (tmp_path / "csv" / "scalars").touch()
    trackers.add({"steps": 100})
    trackers.add({"steps": 200})
    assert len(said) == 1
    assert "The tracker csv has failed" in said[0]
