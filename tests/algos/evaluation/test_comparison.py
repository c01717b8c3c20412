"""Evaluation of the same policy in several backends."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

from rover_rl.algos.evaluation.episodes import draw_episodes
from rover_rl.algos.evaluation.evaluate import Evaluation, evaluate
from rover_rl.algos.evaluation.report import change, print_table
from rover_rl.cli import main
from tests.algos.drivers import straight
from tests.algos.evaluation.drives import FIELD, printed

EPISODES = draw_episodes(FIELD, count=3, seed=1)
SLIPPERY = "tests.algos.evaluation.slippery:Slippery"


@pytest.fixture(scope="module")
def firm() -> Evaluation:
    return evaluate(straight, EPISODES, name="straight")


def copied(evaluation: Evaluation, backend: str, missed: list[int]) -> Evaluation:
    """The evaluation as if it were of another backend, and as if the episodes ``missed`` had ended at the limit."""
    trajectories = [
        replace(trajectory, ending="time limit") if number in missed else trajectory
        for number, trajectory in enumerate(evaluation.trajectories)
    ]
    return replace(evaluation, env=replace(evaluation.env, backend=backend), trajectories=trajectories)


def table(*evaluations: Evaluation, **options) -> str:
    return printed(print_table, evaluations, **options)


def test_episodes_with_a_goal_in_some_backends_only_are_told(firm: Evaluation) -> None:
    assert firm.endings == ["goal"] * 3
    text = table(firm, copied(firm, "warp", [1]))
    assert "in one backend and not in another: episodes 1 (bullet goal, warp time limit)\n" in text
    assert "straight: the backends agree on which episodes" in table(firm, copied(firm, "warp", []))
    missed = copied(firm, "warp", [0, 1, 2])
    moved = replace(EPISODES, start=EPISODES.start + 0.1)
    changes = ({"name": "another"}, {"seconds": 30.0}, {"action_repeat": 2}, {"episodes": moved})
    for other in (*(replace(missed, **changed) for changed in changes), copied(missed, "bullet", [])):
        assert "in one backend and not in another" not in table(firm, other)


# --- the command


def run(tmp_path: Path, *options: str) -> int:
    return main(["evaluate", "scripted", "--world", "maze", *options, "--out", str(tmp_path)])


def test_backends_drive_the_same_episodes(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert run(tmp_path, "--backend", "bullet", SLIPPERY, "--count", "1", "--seconds", "5") == 0
    results = json.loads((tmp_path / "evaluation.json").read_text())
    assert [entry["backend"] for entry in results] == ["bullet", SLIPPERY]
    starts = [[(episode["start"], episode["goal"]) for episode in entry["episodes"]] for entry in results]
    assert starts[0] == starts[1]
    reached = [{n for n, one in enumerate(entry["episodes"]) if one["ending"] == "goal"} for entry in results]
    assert reached[0] > reached[1]
    pictures = {path.name for path in tmp_path.glob("*.png")}
    assert pictures == {"paths-bullet.png", f"paths-{SLIPPERY.replace(':', '-')}.png"}
    assert "in one backend and not in another" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("backend", "message"),
    [("gazebo", "unknown backend 'gazebo'"), ("tests.algos.evaluation.slippery:NotInstalled", "needs a library")],
)
def test_backends_that_cannot_be_used_fail_before_anything_is_driven(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, backend: str, message: str
) -> None:
    def unexpected(*_: object, **__: object) -> None:
        raise AssertionError("drives before all backends are checked")

    monkeypatch.setattr("rover_rl.algos.evaluation.evaluate.evaluate", unexpected)
    assert run(tmp_path / "new", "--backend", "bullet", backend) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.count("\n") == 1
    assert message in captured.err
    assert not (tmp_path / "new").exists()


def test_imperfections_are_compared_with_exact_sensors(firm: Evaluation) -> None:
    exact = replace(firm, imperfection="exact")
    late = replace(copied(firm, "bullet", [0, 1]), imperfection="late")
    shown = table(exact, late)
    assert "Success, and its change against exact" in shown
    assert "-66.7" in shown
    assert change(late, exact).value == pytest.approx(-2 / 3)
    assert change(exact, exact).value == 0
    assert late.summary()["imperfection"] == late.episode_rows()[0]["imperfection"] == "late"
    # Results of one kind of sensors are shown as always.
    assert "exact" not in table(firm)
    assert "imperfection" not in firm.summary()


def test_the_command_drives_with_imperfections(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    options = ["--world", "maze", "--count", "2", "--seconds", "0.5", "--backend", "warp", "--out", str(tmp_path)]
    assert main(["evaluate", "scripted", "--imperfect", "late", "all", *options]) == 0
    assert "Success, and its change against exact" in capsys.readouterr().out
    results = json.loads((tmp_path / "evaluation.json").read_text())
    assert [one["imperfection"] for one in results] == ["exact", "late", "all"]
    delays = [one["env"]["randomization"]["scan_latency"] for one in results]
    assert delays == [[0, 0], [3, 3], [1, 2]]
    assert main(["evaluate", "scripted", "--imperfect", "latte", *options]) != 0
    assert "unknown imperfection 'latte', perhaps 'late'" in capsys.readouterr().err
