from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from rover_rl.algos import ppo
from rover_rl.algos.config import PPOConfig, default_workers
from rover_rl.algos.evaluate import draw_episodes, evaluate
from rover_rl.algos.ppo import train_ppo
from rover_rl.algos.progress import read_progress
from rover_rl.algos.runs import Checkpoint

TINY = PPOConfig(total_steps=256, num_envs=4, decisions=8, epochs=2, minibatch=16, hidden=(16,))


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> ppo.TrainingSummary:
    return train_ppo(replace(TINY, runs=str(tmp_path_factory.mktemp("runs"))))


def same(a: dict[str, torch.Tensor], b: dict[str, torch.Tensor]) -> bool:
    return a.keys() == b.keys() and all(torch.equal(a[key], b[key]) for key in a)


def test_a_run_leaves_its_settings_its_progress_and_its_policy(run: ppo.TrainingSummary) -> None:
    assert run.folder.name == "ppo-maze"
    assert not run.interrupted
    names = {file.name for file in run.folder.iterdir()}
    assert names == {"config.json", "progress.csv", "checkpoint.pt"}
    assert json.loads((run.folder / "config.json").read_text())["num_envs"] == 4
    columns = read_progress(run.folder / "progress.csv")
    assert columns["steps"][-1] == run.steps
    assert 256 <= run.steps <= 256 + 128
    assert columns["learning_rate"][0] == pytest.approx(3e-4)
    assert columns["learning_rate"][-1] < 3e-4


def test_the_policy_that_was_trained_can_be_evaluated(run: ppo.TrainingSummary) -> None:
    checkpoint = Checkpoint.load(run.checkpoint)
    assert (checkpoint.algorithm, checkpoint.steps) == ("ppo", run.steps)
    assert len(evaluate(checkpoint.make_actor(), draw_episodes("maze", 2), seconds=1).endings) == 2


def test_the_same_seed_gives_the_same_weights_to_the_last_bit(run: ppo.TrainingSummary, tmp_path: Path) -> None:
    first = Checkpoint.load(run.checkpoint)
    again = Checkpoint.load(train_ppo(replace(TINY, runs=str(tmp_path))).checkpoint)
    other = Checkpoint.load(train_ppo(replace(TINY, runs=str(tmp_path), seed=1)).checkpoint)
    assert same(first.actor, again.actor)
    assert same(first.critic, again.critic)
    assert not same(first.actor, other.actor)


def test_ctrl_c_keeps_what_was_learned(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    update = ppo.Learner.update
    calls = []

    def interrupted(self: ppo.Learner, *args: object) -> dict[str, float]:
        calls.append(1)
        if len(calls) == 2:
            raise KeyboardInterrupt
        return update(self, *args)

    monkeypatch.setattr(ppo.Learner, "update", interrupted)
    summary = train_ppo(replace(TINY, total_steps=10_000, runs=str(tmp_path)))
    assert summary.interrupted
    assert Checkpoint.load(summary.checkpoint).steps == summary.steps > 0


@pytest.mark.slow
def test_two_workers_share_the_rovers(tmp_path: Path) -> None:
    summary = train_ppo(replace(TINY, workers=2, runs=str(tmp_path)))
    assert 256 <= summary.steps <= 256 + 128
    assert summary.checkpoint.is_file()


def test_time_can_be_the_budget(tmp_path: Path) -> None:
    summary = train_ppo(replace(TINY, total_steps=10**9, max_minutes=1e-6, runs=str(tmp_path)))
    assert len(read_progress(summary.folder / "progress.csv")["steps"]) == 1


def test_errors_come_before_anything_is_written(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="unknown world 'mars'"):
        train_ppo(replace(TINY, world="mars", runs=str(tmp_path)))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("total_steps", 0),
        ("learning_rate", 0.0),
        ("gamma", 1.1),
        ("entropy", -1.0),
        ("max_minutes", 0.0),
        ("workers", 3),
        ("hidden", ()),
    ],
)
def test_settings_out_of_range_raise(field: str, value: object) -> None:
    with pytest.raises(ValueError, match=field):
        replace(TINY, **{field: value}).check()


def test_default_workers_share_the_rovers_equally() -> None:
    assert default_workers(1) == 1
    assert 64 % default_workers(64) == 0
