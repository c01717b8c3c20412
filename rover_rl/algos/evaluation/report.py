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

from rover_rl.algos.evaluation.comparison import Disagreement, backends_of, disagreements_of, find_disagreements
from rover_rl.algos.evaluation.evaluate import EndlessEvaluation, Evaluation
from rover_rl.algos.evaluation.metrics import METRICS, Estimate
from rover_rl.algos.evaluation.results import worst_worlds
from rover_rl.files import write_json, written_whole

COMPARED = (
    "success_rate",
    "contact_free_success_rate",
    "spl",
    "mean_time_to_traverse",
    "goals_per_episode",
    "seconds_per_goal",
    "ended_early",
    "collisions",
    "body_contact_share",
)
"""Metrics with a column for each backend in a table of several backends."""
LISTED = 20
"""Largest number of printed episodes on which backends disagree."""


def print_table(
    evaluations: Sequence[Evaluation | EndlessEvaluation],
    console: Console | None = None,
    groups: Mapping[str, str] | None = None,
) -> None:
    """Prints a table of policies for each world and mode, with 95 % confidence intervals below the values.

    Ranges of worlds share a table, in which each has a row. Below, the worlds with the lowest success rates.

    Policies in several backends have a row with a group of columns for each backend, with fewer metrics. Below, the
    first 20 episodes that reach their goal in one backend and not in another.

    Args:
        evaluations: evaluations to print, of any worlds and modes.
        console: console to print to; ``None``: standard output.
        groups: group name of each policy that belongs to a group, by the policy's name. Each group of several policies,
            such as those that differ in their seed only, has a row with its mean and standard deviation.
    """
    console = console or Console()
    if not console.is_terminal:
        console.width = max(console.width, 140)
    measured: set[str] = set()
    for title in dict.fromkeys(evaluation.title for evaluation in evaluations):
        together = [evaluation for evaluation in evaluations if evaluation.title == title]
        console.print(_table(title, together, groups or {}))
        measured.update(key for key in together[0].metrics if key in COMPARED or not backends_of(together))
    for evaluation in evaluations:
        if isinstance(evaluation, Evaluation) and evaluation.episodes.several_worlds:
            console.print(_worst_worlds(evaluation), highlight=False, soft_wrap=True)
    if (disagreements := find_disagreements(evaluations)) is not None:
        _print_disagreements(disagreements, console)
    legend = dict.fromkeys(
        f"{metric.heading}: {metric.meaning}" for key, metric in METRICS.items() if key in measured and metric.meaning
    )
    console.print("; ".join(legend) + ". Below each value: 95 % confidence interval.", style="dim")


def _worst_worlds(evaluation: Evaluation) -> str:
    """Returns a line with the worlds that have the lowest success rates."""
    worlds = {world["world"]: world for world in evaluation.worlds}
    worst = (worlds[index] for index in worst_worlds([evaluation]))
    named = ", ".join(f"{world['name']} {world['success_rate']:.0%}" for world in worst if world["success_rate"] < 1)
    policy = escape(f"{evaluation.name} in {evaluation.world_name}, {evaluation.backend}")
    return f"Lowest success rates of {policy}: {escape(named)}" if named else f"{policy}: all episodes reach their goal"


def _table(title: str, evaluations: Sequence[Evaluation | EndlessEvaluation], groups: Mapping[str, str]) -> Table:
    """Table with a row for each policy and for each group of policies, and a group of columns for each backend."""
    backends = backends_of(evaluations)
    shown = [key for key in METRICS if key in evaluations[0].metrics and _is_shown(key, evaluations)]
    if backends:
        shown = [key for key in shown if key in COMPARED]
    table = Table(title=title, box=SIMPLE_HEAD, padding=(0, 1, 0, 0))
    ranges = any(isinstance(one, Evaluation) and one.episodes.several_worlds for one in evaluations)
    table.add_column("policy\n[dim]worlds[/dim]" if ranges else "policy", overflow="fold")
    columns: Sequence[str | None] = backends or [None]
    for backend in columns:
        for key in shown:
            above = "" if backend is None else f"{escape(backend) if key == shown[0] else ''}\n"
            table.add_column(f"{above}{METRICS[key].heading}\n{METRICS[key].unit}", justify="right", overflow="fold")
    for (name, world), line in _lines(evaluations, bool(backends)):
        cells = (
            _cell(key, line[column].metrics[key]) if column in line else "-" for column in columns for key in shown
        )
        table.add_row(escape(name) + (f"\n[dim]{escape(world)}[/dim]" if ranges else ""), *cells)
    places = dict.fromkeys((groups[one.name], one.world_name) for one in evaluations if one.name in groups)
    for group, world in places:
        members = [one for one in evaluations if (groups.get(one.name), one.world_name) == (group, world)]
        parts = [[one for one in members if backend in (None, one.backend)] for backend in columns]
        count = max(map(len, parts))
        if count > 1:
            cells = (_mean_cell(key, [one.metrics[key].value for one in part]) for part in parts for key in shown)
            note = f"{count} policies" + (f", {world}" if ranges else "")
            table.add_row(f"{escape(group)}\n[dim]{escape(note)}[/dim]", *cells)
    return table


def _lines(
    evaluations: Sequence[Evaluation | EndlessEvaluation], together: bool
) -> list[tuple[tuple[str, str], dict[str | None, Evaluation | EndlessEvaluation]]]:
    """Lines of a table: names of policy and world, and its evaluation in each backend.

    Unless ``together``, there is one evaluation without a key. Further evaluations of the same policy in the same world
    and backend get further lines.
    """
    lines: list[tuple[tuple[str, str], dict[str | None, Evaluation | EndlessEvaluation]]] = []
    for evaluation in evaluations:
        column, names = evaluation.backend if together else None, (evaluation.name, evaluation.world_name)
        free = (line for key, line in lines if key == names and column not in line)
        if (line := next(free, None)) is None:
            lines.append((names, {column: evaluation}))
        else:
            line[column] = evaluation
    return lines


def _print_disagreements(disagreements: Sequence[Disagreement], console: Console) -> None:
    """Prints the first episodes on which backends disagree."""
    if not disagreements:
        console.print("The backends agree on which episodes reach their goal.")
        return
    console.print(_disagreement_table(disagreements[:LISTED]))
    if len(disagreements) > LISTED:
        console.print(f"{len(disagreements) - LISTED} more such episodes: see evaluation.json.")


def _disagreement_table(disagreements: Sequence[Disagreement]) -> Table:
    backends = dict.fromkeys(backend for one in disagreements for backend in one.endings)
    title = "Episodes that reach their goal in one backend and not in another"
    table = Table(title=title, box=SIMPLE_HEAD, padding=(0, 1, 0, 0))
    for heading in ("policy", "world", "episode", "start\nx, y, yaw", "goal\nx, y", *backends):
        table.add_column(escape(heading), overflow="fold")
    for one in disagreements:
        start, goal = (", ".join(f"{number:.2f}" for number in numbers) for numbers in (one.start, one.goal))
        endings = (one.endings.get(backend, "-") for backend in backends)
        table.add_row(escape(one.policy), escape(one.world), str(one.episode), start, goal, *endings)
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

    Evaluations in several worlds also have a CSV file with one row per world, whose name ends in ``-worlds.csv``.

    Evaluations of a policy in several backends also list ``disagreements``: the episodes that reach their goal in one
    backend and not in another. The CSV file has their indices.

    Args:
        path: path of the JSON file; the CSV file has the same name with the suffix ``.csv``.
        evaluations: evaluations to write, of any worlds and modes.
    """
    disagreements = [disagreements_of(evaluation, evaluations) for evaluation in evaluations]
    results = [
        evaluation.to_json() | ({} if found is None else {"disagreements": [one.to_json() for one in found]})
        for evaluation, found in zip(evaluations, disagreements, strict=True)
    ]
    write_json(path, results)
    rows: list[dict[str, Any]] = []
    for evaluation, found in zip(evaluations, disagreements, strict=True):
        row = evaluation.summary()
        if found is not None:
            row["disagreements"] = " ".join(str(one.episode) for one in found)
        for key, estimate in evaluation.metrics.items():
            row |= {key: estimate.value, f"{key}_low": estimate.low, f"{key}_high": estimate.high}
        rows.append(row)
    write_rows(path.with_suffix(".csv"), rows)
    by_world = [
        {"policy": one.name, "backend": one.backend, "worlds": one.world_name, **world}
        for one in evaluations
        if isinstance(one, Evaluation) and one.episodes.several_worlds
        for world in one.worlds
    ]
    if by_world:
        write_rows(path.with_name(f"{path.stem}-worlds.csv"), by_world)


def write_rows(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Writes rows as CSV, with a column for each key that occurs in them."""
    columns = dict.fromkeys(key for row in rows for key in row)
    with written_whole(path) as temporary, temporary.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(columns))
        writer.writeheader()
        writer.writerows(rows)
