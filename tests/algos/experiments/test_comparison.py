from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import pytest

from rover_rl.algos.config import training_config
from rover_rl.algos.experiments.comparison import IN_TRAINING, compare, write_comparison
from rover_rl.algos.experiments.runs import Run, find_runs, group
from tests.algos.evaluation.drives import csv_rows
from tests.algos.experiments.records import write_run


def write_experiment(folder: Path, name: str, best: float = 1.0, seeds: int = 3, **settings: Any) -> list[Path]:
    """Writes runs whose success rates end at ``best`` and a little below."""
    return [
        write_run(folder / f"{name}-seed{s}", training_config("ppo", seed=s, **settings), best=best - s / 100)
        for s in range(seeds)
    ]


def test_runs_are_found_by_folder_parent_and_name(tmp_path: Path) -> None:
    runs = write_experiment(tmp_path, "mine", seeds=11)
    assert find_runs([str(tmp_path / "mine")]) == runs
    assert find_runs([str(tmp_path)]) == runs
    assert find_runs([str(runs[3]), str(tmp_path)]) == [runs[3], *runs[:3], *runs[4:]]
    with pytest.raises(FileNotFoundError, match="no run at"):
        find_runs([str(tmp_path / "yours")])


def test_experiments_have_the_name_of_their_folders_or_their_settings(tmp_path: Path) -> None:
    mine = write_experiment(tmp_path, "mine", gamma=0.9)
    others = [write_run(tmp_path / name, training_config("ppo", seed=s)) for s, name in enumerate(("a", "b"))]
    alone = write_run(tmp_path / "alone", training_config("sac"))
    experiments = group([Run.read(folder) for folder in (*mine, *others, alone)])
    assert [(one.name, len(one.runs)) for one in experiments] == [("mine", 3), ("PPO, gamma=0.96", 2), ("alone", 1)]


def test_experiments_are_compared_by_their_final_success_in_training(tmp_path: Path) -> None:
    write_experiment(tmp_path, "good")
    write_experiment(tmp_path, "bad", best=0.5, gamma=0.9)
    comparison = compare(find_runs([str(tmp_path)]), level=0.8)
    good, bad = comparison.rows
    assert (good.name, good.runs, good.reached, bad.name, bad.reached) == ("good", 3, 3, "bad", 0)
    # The rate rises linearly over 40 batches of 4,096 steps and a tenth of a minute.
    assert good.success.value == pytest.approx(0.99 * (1 - 1 / 24), abs=0.02)
    assert good.steps == pytest.approx(0.8 * 40 * 4096, rel=0.05)
    assert good.minutes == pytest.approx(0.8 * 4, rel=0.05)
    (pair,) = comparison.pairs
    assert (pair.better, pair.other, pair.probability.value) == ("good", "bad", 1)
    assert comparison.scored_by == IN_TRAINING
    write_comparison(comparison, tmp_path / "out")
    data = json.loads((tmp_path / "out" / "comparison.json").read_text())
    assert [one["experiment"] for one in data["experiments"]] == ["good", "bad"]
    assert data["experiments"][1]["steps"] is None
    assert data["pairs"][0]["probability"] == 1
    assert [row["seed"] for row in csv_rows(tmp_path / "out" / "runs.csv")] == [*"012012"]
    assert (tmp_path / "out" / "comparison.csv").read_text().count("\n") == 3
    assert (tmp_path / "out" / "comparison.png").stat().st_size > 10_000


def evaluation(folder: Path, **rates: float) -> None:
    shared = {"mode": "one goal", "count": 64, "world": "moon", "time_limit": 60.0, "backend": "bullet"}
    results = [{"policy": n, **shared, "metrics": {"success_rate": {"value": r}}} for n, r in rates.items()]
    (folder / "evaluation.json").write_text(json.dumps(results))


def test_an_evaluation_that_all_runs_share_counts_instead_of_training(tmp_path: Path) -> None:
    gammas = {"one": 0.9, "two": 0.96}
    runs = [write_run(tmp_path / name, training_config("ppo", gamma=gamma)) for name, gamma in gammas.items()]
    for folder in runs:
        (folder / "checkpoint.pt").touch()
    # The command writes the results of all policies into the first one's folder.
    evaluation(runs[0], one=0.25)
    assert compare(runs).scored_by == IN_TRAINING
    evaluation(runs[0], one=0.25, two=0.75, scripted=1.0)
    comparison = compare(runs)
    assert comparison.scored_by == "64 episodes in moon, 60 s, bullet"
    assert {row.name: row.success.value for row in comparison.rows} == {"one": 0.25, "two": 0.75}
    # A policy that was trained on since has no evaluation.
    later = (runs[0] / "evaluation.json").stat().st_mtime + 10
    os.utime(runs[1] / "checkpoint.pt", (later, later))
    assert compare(runs).scored_by == IN_TRAINING


def test_what_cannot_be_compared_raises(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="name the folders"):
        compare([])
    with pytest.raises(ValueError, match="success must be above 0"):
        compare([tmp_path], level=90)
