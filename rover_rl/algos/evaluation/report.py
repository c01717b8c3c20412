"""Evaluation reports: tables on the terminal, JSON and CSV files.

Example:
    >>> episodes = stored_episodes("maze")
    >>> print_table([evaluate(ScriptedPolicy(), episodes, name="scripted"), evaluate(None, episodes)])
"""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from rover_rl.algos.evaluation.evaluate import EndlessEvaluation, Evaluation
from rover_rl.algos.evaluation.metrics import METRICS, Estimate
from rover_rl.files import write_json, written_whole


def print_table(
    evaluations: Sequence[Evaluation | EndlessEvaluation],
    console: Console | None = None,
    groups: Mapping[str, str] | None = None,
) -> None:
    """Prints a table of policies for each world and mode, with 95 % confidence intervals below the values.

    Args:
        evaluations: evaluations to print, of any worlds and modes.
        console: console to print to; ``None``: standard output.
        groups: group name of each policy that belongs to a group, by the policy's name. Each group of several policies,
            such as those that differ in their seed only, has a row with its mean and standard deviation.
    """
    console = console or Console()
    if not console.is_terminal:
        console.width = max(console.width, 140)
    for title in dict.fromkeys(evaluation.title for evaluation in evaluations):
        console.print(_table(title, [e for e in evaluations if e.title == title], groups or {}))
    measured = [METRICS[key] for key in METRICS if any(key in e.metrics for e in evaluations)]
    legend = dict.fromkeys(f"{metric.heading}: {metric.meaning}" for metric in measured if metric.meaning)
    console.print("; ".join(legend) + ". Below each value: 95 % confidence interval.", style="dim")


def _table(title: str, evaluations: Sequence[Evaluation | EndlessEvaluation], groups: Mapping[str, str]) -> Table:
    shown = [key for key in METRICS if key in evaluations[0].metrics and _is_shown(key, evaluations)]
    table = Table(title=title, box=SIMPLE_HEAD, padding=(0, 1, 0, 0))
    table.add_column("policy", overflow="fold")
    for key in shown:
        table.add_column(f"{METRICS[key].heading}\n{METRICS[key].unit}", justify="right", overflow="fold")
    for evaluation in evaluations:
        table.add_row(escape(evaluation.name), *(_cell(key, evaluation.metrics[key]) for key in shown))
    for group in dict.fromkeys(groups.values()):
        members = [evaluation for evaluation in evaluations if groups.get(evaluation.name) == group]
        if len(members) > 1:
            cells = (_mean_cell(key, [member.metrics[key].value for member in members]) for key in shown)
            table.add_row(f"{escape(group)}\n[dim]{len(members)} policies[/dim]", *cells)
    return table


def _is_shown(key: str, evaluations: Sequence[Evaluation | EndlessEvaluation]) -> bool:
    """Whether a metric has a column: false for undefined metrics and for endings that do not occur."""
    values = [evaluation.metrics[key].value for evaluation in evaluations]
    return any(value > 0 for value in values) or not (key.startswith("ending_") or all(map(math.isnan, values)))


def _cell(key: str, estimate: Estimate) -> str:
    """Formats a value and, below it, its confidence interval."""
    if math.isnan(estimate.value):
        return "-"
    if math.isnan(estimate.low):
        return _formatted(key, estimate.value)
    ends = (estimate.low, estimate.high)
    low, high = (f"{100 * end:.0f}" if METRICS[key].unit == "%" else _formatted(key, end) for end in ends)
    return f"{_formatted(key, estimate.value)}\n[dim]{low}–{high}[/dim]"


def _mean_cell(key: str, values: Sequence[float]) -> str:
    """Formats the mean of several policies and, below it, their standard deviation; ``-`` if a value is undefined."""
    mean, deviation = torch.tensor(values).mean().item(), torch.tensor(values).std().item()
    return "-" if math.isnan(mean) else f"{_formatted(key, mean)}\n[dim]± {_formatted(key, deviation)}[/dim]"


def _formatted(key: str, value: float) -> str:
    """Formats a value in the unit of its column."""
    unit = METRICS[key].unit
    if unit == "%":
        return f"{100 * value:.1f}"
    return f"{value:.1f}" if unit == "s" else f"{value:.2f}"


def write_evaluation(path: Path, evaluations: Sequence[Evaluation | EndlessEvaluation]) -> None:
    """Writes evaluations as a JSON file with every episode, and as a CSV file with one row per evaluation.

    Args:
        path: path of the JSON file; the CSV file has the same name with the suffix ``.csv``.
        evaluations: evaluations to write, of any worlds and modes.
    """
    write_json(path, [evaluation.to_json() for evaluation in evaluations])
    rows: list[dict[str, Any]] = []
    for evaluation in evaluations:
        row = evaluation.summary()
        for key, estimate in evaluation.metrics.items():
            row |= {key: estimate.value, f"{key}_low": estimate.low, f"{key}_high": estimate.high}
        rows.append(row)
    columns = dict.fromkeys(key for row in rows for key in row)
    with written_whole(path.with_suffix(".csv")) as temporary, temporary.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(columns))
        writer.writeheader()
        writer.writerows(rows)
