"""Comparison of experiments: table, JSON, CSV and learning curves.

Example:
    >>> comparison = compare(find_runs(["runs/ppo-moon", "runs/sac-moon"]))
    >>> print_comparison(comparison)
    >>> write_comparison(comparison, Path("runs/comparison"))
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from rover_rl.algos.evaluation.metrics import Estimate, finite_row
from rover_rl.algos.evaluation.report import Column, cell, estimate_row, print_tables, write_rows
from rover_rl.algos.experiments.curves import COMPARED, draw_learning_curve
from rover_rl.algos.experiments.runs import Against, Experiment, Run, evaluated_success, group
from rover_rl.algos.experiments.statistics import interquartile_mean, probability_of_improvement
from rover_rl.files import MADE_BY, write_json

IN_TRAINING = "last twelfth of training"  # what success rates are of if the runs have no evaluation in common
ALL_WORLDS = "all worlds"  # heading of the results over several worlds
_FEW = 5  # number of runs below which intervals are far too narrow


@dataclass(frozen=True)
class Row:
    """Result of the experiments with the same settings in one world or in all of them (:data:`ALL_WORLDS`)."""

    world: str
    name: str
    settings: str
    scores: list[np.ndarray]  #: Success rates of the runs in each world, ``[runs]`` each.
    success: Estimate  #: Interquartile mean of the scores.
    reached: int
    steps: float  #: Median to the level; infinity if half of the runs do not reach it.
    minutes: float  #: The same in minutes of training.

    @property
    def runs(self) -> int:
        return sum(map(len, self.scores))


@dataclass(frozen=True)
class Pair:
    """Probability that a run of one experiment is better than one of another."""

    world: str
    better: str
    other: str
    probability: Estimate


@dataclass(frozen=True)
class Comparison:
    """Comparison of experiments: results in each world, then in all of them."""

    runs: list[Run]
    scored_by: str  #: What the success rates are of: an evaluation, or the last twelfth of training.
    level: float  #: Success rate of ``steps`` and ``minutes`` in the rows.
    scores: dict[Path, float]  #: Success rates of the runs by their folders.
    rows: list[Row]
    pairs: list[Pair]


def compare(folders: Sequence[Path], level: float = 0.9) -> Comparison:
    """Compares runs, which are grouped by their settings without the seed.

    The success rates are those of an evaluation if all runs have one in common, on the same episodes, else those of
    the last twelfth of training. ``level`` is the success rate in training that a run takes some steps and minutes to.

    Raises a ``FileNotFoundError`` if a folder holds no run, and a ``ValueError`` for no runs, a run without rows, or a
    level that is no rate.
    """
    if not folders:
        raise ValueError("name the folders of the runs to compare")
    if not 0 < level <= 1:
        raise ValueError(f"success must be above 0 and at most 1, got {level}")
    runs = [Run.read(folder) for folder in folders]
    scored_by, scores = evaluated_success(runs) or (IN_TRAINING, {run.folder: run.final_success for run in runs})
    by_world: dict[str, list[Experiment]] = {}
    for experiment in group(runs):
        by_world.setdefault(experiment.world, []).append(experiment)
    tables = [(world, [[one] for one in experiments]) for world, experiments in by_world.items()]
    # Experiments with the same settings in every world.
    by_settings = [{one.settings: one for one in experiments} for experiments in by_world.values()]
    shared = [name for name in by_settings[0] if all(name in others for others in by_settings)]
    if len(by_world) > 1 and shared:
        tables.append((ALL_WORLDS, [[world[name] for world in by_settings] for name in shared]))
    rows, pairs = [], []
    for world, experiments in tables:
        here = [_row(world, strata, scores, level) for strata in experiments]
        here.sort(key=lambda row: np.nan_to_num(row.success.value, nan=-1.0), reverse=True)
        rows += here
        for one, other in combinations(here, 2):
            pairs.append(Pair(world, one.name, other.name, probability_of_improvement(one.scores, other.scores)))
    return Comparison(runs, scored_by, level, scores, rows, pairs)


def _row(world: str, strata: Sequence[Experiment], scores: dict[Path, float], level: float) -> Row:
    values = [np.array([scores[run.folder] for run in experiment.runs]) for experiment in strata]
    runs = [run for experiment in strata for run in experiment.runs]

    def median(against: Against) -> float:
        times = sorted(run.first_at(level, against) for run in runs)
        # The mean of a number and infinity would be infinity, the median of two infinities nan.
        return float(np.median(times)) if math.isfinite(times[len(times) // 2]) else math.inf

    settings, reached = strata[0].settings, sum(math.isfinite(run.first_at(level, "steps")) for run in runs)
    name = strata[0].name if len(strata) == 1 else settings
    return Row(world, name, settings, values, interquartile_mean(values), reached, median("steps"), median("minutes"))


def print_comparison(comparison: Comparison, console: Console | None = None) -> None:
    """Prints a table of the experiments in each world, and how probable it is that one is better than another."""
    console, level = console or Console(), f"{comparison.level:.0%}"
    for world in dict.fromkeys(row.world for row in comparison.rows):
        rows = [row for row in comparison.rows if row.world == world]
        columns = [
            Column("runs", "", [str(row.runs) for row in rows]),
            Column("success", "%", [cell(row.success, "%") for row in rows]),
            Column(f"reach {level}", "", [str(row.reached) for row in rows]),
            Column(f"steps to {level}", "", [_or_none(float(f"{row.steps:.2g}"), ",.0f") for row in rows]),
            Column(f"minutes to {level}", "", [_or_none(row.minutes, ".1f") for row in rows]),
        ]
        names = [row.name if row.settings == row.name else f"{row.name}\n{row.settings}" for row in rows]
        print_tables(f"{world}: {comparison.scored_by}", names, columns, console, heading="experiment")
        for pair in (pair for pair in comparison.pairs if pair.world == world):
            value, low, high = (100 * end for end in vars(pair.probability).values())
            ends = "" if math.isnan(low) else f" [{low:.0f}–{high:.0f}]"
            better = f"Probability that a run of {pair.better} is better than one of {pair.other}"
            console.print(f"{better}: {value:.0f} %{ends}", highlight=False, markup=False)
    intervals = "success: interquartile mean of the runs; below it and in brackets: 95 % bootstrap interval over runs"
    medians = f"to {level}: median of the runs, in training"
    few = f"; with fewer than {_FEW} runs, intervals are too narrow" * any(row.runs < _FEW for row in comparison.rows)
    console.print(f"{intervals}; {medians}{few}.", style="dim", highlight=False)


def _or_none(value: float, form: str) -> str:
    return format(value, form) if math.isfinite(value) else "-"


def write_comparison(comparison: Comparison, folder: Path) -> None:
    """Writes ``comparison.png``, ``comparison.csv`` (experiments), ``runs.csv`` and ``comparison.json``."""
    draw_learning_curve([run.folder for run in comparison.runs], folder / "comparison.png", panels=COMPARED)
    experiments = [
        {"world": row.world, "experiment": row.name, "settings": row.settings, "runs": row.runs}
        | estimate_row({"success": row.success})
        | {"reached": row.reached, "steps": row.steps, "minutes": row.minutes}
        for row in comparison.rows
    ]
    pairs = [
        {"world": pair.world, "better": pair.better, "other": pair.other}
        | estimate_row({"probability": pair.probability})
        for pair in comparison.pairs
    ]
    runs = [
        {
            **{"run": str(run.folder), "experiment": experiment.name, "world": experiment.world},
            **{"seed": run.config.seed, "success": comparison.scores[run.folder]},
            **{"final_training_success": run.final_success, "steps": int(run.end("steps"))},
            "minutes": run.end("minutes"),
            "steps_to_level": run.first_at(comparison.level, "steps"),
            "minutes_to_level": run.first_at(comparison.level, "minutes"),
        }
        for experiment in group(comparison.runs)
        for run in experiment.runs
    ]
    tables: dict[str, Any] = {"experiments": experiments, "pairs": pairs, "runs": runs}
    finite = {name: [finite_row(row) for row in rows] for name, rows in tables.items()}
    write_rows(folder / "comparison.csv", finite["experiments"])
    write_rows(folder / "runs.csv", finite["runs"])
    found = {"success_of": comparison.scored_by, "level": comparison.level}
    write_json(folder / "comparison.json", {**MADE_BY, **found, **finite})
