"""Reports of benchmarks: a table on the terminal, JSON and CSV files, and a picture of the worst runs."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape

from rover_rl.algos.benchmarks.suite import JITTER, Result
from rover_rl.algos.evaluation.metrics import Estimate
from rover_rl.algos.evaluation.plots import draw_panels
from rover_rl.algos.evaluation.report import write_rows
from rover_rl.algos.evaluation.results import plain_env_or_none
from rover_rl.algos.evaluation.tables import Column, fitting_tables
from rover_rl.files import write_json

WORST_RUNS = 6
"""Number of runs in a picture."""


def print_results(results: Sequence[Result], console: Console | None = None) -> None:
    """Prints a table of policies with 95 % confidence intervals, and what differs from the original benchmark.

    Args:
        results: results of policies in the same suite.
        console: console to print to; ``None``: standard output.
    """
    console = console or Console()
    suite = results[0].suite
    columns = [
        Column(heading, unit, [_cell(result.metrics[key], unit) for result in results])
        for key, (heading, unit) in suite.columns.items()
    ]
    for table in fitting_tables(suite.title, [result.name for result in results], columns, console):
        console.print(table)
    told = dict.fromkeys(line for result in results for line in suite.differences(result.evaluation.env))
    console.print("What differs from the original benchmark:")
    for line in told:
        console.print(f"- {escape(line)}", highlight=False, soft_wrap=True)
    console.print("Below a value: 95 % confidence interval.", style="dim")


def _cell(estimate: Estimate, unit: str) -> str:
    """Formats a value and, below it, its confidence interval."""
    if math.isnan(estimate.value):
        return "-"
    factor, digits = (100, 1) if unit == "%" else (1, 1 if unit else 3)
    value, low, high = (f"{factor * number:.{digits}f}" for number in (estimate.value, estimate.low, estimate.high))
    return value if math.isnan(estimate.low) else f"{value}\n{low}–{high}"


def write_results(path: Path, results: Sequence[Result]) -> None:
    """Writes results as a JSON file with every run, and as a CSV file with one row per run.

    Args:
        path: path of the JSON file; the CSV file has the same name with the suffix ``.csv``.
        results: results of policies in the same suite.
    """
    suite = results[0].suite
    heads = [{"policy": result.name, "backend": result.evaluation.backend} for result in results]
    write_json(
        path,
        {
            "benchmark": suite.name,
            "worlds": [course.number for course in suite.courses],
            "runs": suite.runs,
            "seed": suite.seed,
            "jitter": JITTER,
            "goal_radius": suite.goal_radius,
            "seconds": suite.seconds,
            "policies": [head | _plain(result) for head, result in zip(heads, results, strict=True)],
        },
    )
    rows = [head | row for head, result in zip(heads, results, strict=True) for row in result.rows()]
    write_rows(path.with_suffix(".csv"), rows)


def _plain(result: Result) -> dict[str, Any]:
    metrics = {
        key: {end: number if math.isfinite(number) else None for end, number in vars(estimate).items()}
        for key, estimate in result.metrics.items()
    }
    env = result.evaluation.env
    return {
        "differences": result.suite.differences(env),
        "env": plain_env_or_none(env),
        "metrics": metrics,
        "runs": result.rows(),
    }


def draw_worst_runs(result: Result, path: Path) -> None:
    """Draws the paths of the runs with the lowest scores, each in its world.

    Args:
        result: results of a policy.
        path: path of the figure; its suffix selects the format.
    """
    rows = result.rows()
    panels = {
        f"world {rows[run]['world']}, run {rows[run]['run']}: "
        f"{rows[run]['ending']} after {rows[run]['seconds']:.1f} s": result.evaluation.select([run])
        for run in result.worst(WORST_RUNS)
    }
    draw_panels(panels, path, f"{result.name} in {result.suite.name}: the runs with the lowest scores")
