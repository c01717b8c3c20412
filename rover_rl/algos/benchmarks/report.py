"""Reports of benchmarks: a table on the terminal, JSON and CSV files, and a picture of the worst runs."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from rich.console import Console
from rich.markup import escape

from rover_rl.algos.benchmarks.suite import JITTER, Result
from rover_rl.algos.evaluation.plots import draw_panels
from rover_rl.algos.evaluation.results import plain_env_or_none, plain_estimates
from rover_rl.algos.evaluation.tables import Column, cell, print_tables, write_rows
from rover_rl.files import MADE_BY, write_json

WORST_RUNS = 6  # number of runs in a picture


def print_results(results: Sequence[Result], console: Console | None = None) -> None:
    """Prints a table of policies in the same suite, and what differs from the original benchmark."""
    console = console or Console()
    suite = results[0].suite
    shown = [part for result in results for part in (result, *result.groups().values())]
    columns = [
        Column(heading, unit, [cell(result.metrics[key], unit, digits=3) for result in shown])
        for key, (heading, unit) in suite.columns.items()
    ]
    print_tables(suite.title, [result.name for result in shown], columns, console)
    told = dict.fromkeys(line for result in results for line in suite.differences(result.evaluation.env))
    console.print("What differs from the original benchmark:")
    for line in told:
        console.print(f"- {escape(line)}", highlight=False, soft_wrap=True)
    console.print("Below a value: 95 % confidence interval.", style="dim")


def write_results(path: Path, results: Sequence[Result]) -> None:
    """Writes results in the same suite as JSON, with every run, and beside it as CSV, with a row per run."""
    suite = results[0].suite
    policies, rows = [], []
    for result in results:
        head = {"policy": result.name, "backend": result.evaluation.backend}
        rows += [head | row for row in result.rows()]
        env = result.evaluation.env
        differs = {"differences": suite.differences(env), "env": plain_env_or_none(env)}
        groups = {name: plain_estimates(part.metrics) for name, part in result.groups().items()}
        metrics = {"metrics": plain_estimates(result.metrics), **({"groups": groups} if groups else {})}
        policies.append({**head, **differs, **metrics, "runs": result.rows()})
    worlds = [course.number for course in suite.courses]
    described = {"benchmark": suite.name, "worlds": worlds, "runs": suite.runs, "seed": suite.seed, "jitter": JITTER}
    limits = {"goal_radius": suite.goal_radius, "seconds": suite.seconds}
    write_json(path, {**MADE_BY, **described, **limits, "policies": policies})
    write_rows(path.with_suffix(".csv"), rows)


def draw_worst_runs(result: Result, path: Path) -> None:
    """Draws the paths of the runs with the lowest scores; the suffix of ``path`` selects the format."""
    rows, panels = result.rows(), []
    for run in result.worst(WORST_RUNS):
        row = rows[run]
        title = f"world {row['world']}, run {row['run']}: {row['ending']} after {row['seconds']:.1f} s"
        panels.append((title, result.evaluation.select([run])))
    draw_panels(panels, path, f"{result.name} in {result.suite.name}: the runs with the lowest scores")
