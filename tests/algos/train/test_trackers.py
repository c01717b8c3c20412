from __future__ import annotations

import math
import re
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest
from torchrl.record.loggers import wandb as torchrl_wandb

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


def test_a_tracker_that_cannot_be_opened_is_named(tmp_path: Path) -> None:
    (tmp_path / "csv").touch()
    with pytest.raises(ValueError, match="the tracker csv cannot be opened"):
        track(tmp_path, "csv")


class FakeRun:
    """The part of a run of Weights & Biases that TorchRL's logger uses."""

    def __init__(self, **arguments: Any) -> None:
        self.arguments = arguments
        self.rows: list[dict[str, Any]] = []
        self.config = self.summary = SimpleNamespace(update=lambda *_, **__: None)
        self.id = arguments["id"] or "abc123"
        Path(arguments["dir"], "wandb", f"offline-run-20260101_000000-{self.id}").mkdir(parents=True, exist_ok=True)

    def define_metric(self, *_: Any, **__: Any) -> None:
        """Metrics need no definition here."""

    def log(self, row: dict[str, Any]) -> None:
        self.rows.append(row)

    def finish(self) -> None:
        self.rows.append({"finished": True})


def test_wandb_gets_rows_settings_and_the_same_run_when_resumed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With a stand-in, as the library is not among those of the tests."""
    runs: list[FakeRun] = []
    fake = ModuleType("wandb")
    fake.init = lambda **arguments: runs.append(FakeRun(**arguments)) or runs[-1]  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "wandb", fake)
    monkeypatch.setattr(torchrl_wandb, "_has_wandb", True)
    monkeypatch.delenv("WANDB_PROJECT", raising=False)
    folder = tmp_path / "mine-seed1"
    assert track(folder, "wandb") == []
    assert track(folder, "wandb", steps=(200,), resumed_at=100) == []
    first, second = runs
    assert first.arguments["config"]["algorithm"]["gamma"] == 0.9
    given = {key: first.arguments[key] for key in ("name", "group", "project", "id")}
    assert given == {"name": "mine-seed1", "group": "mine", "project": "rover_rl", "id": None}
    assert first.rows[0]["goals"] == 1.5
    assert (first.rows[0]["step"], second.rows[0]["step"]) == (100, 200)
    assert first.rows[-1] == {"finished": True}
    assert second.arguments["id"] == "abc123"
