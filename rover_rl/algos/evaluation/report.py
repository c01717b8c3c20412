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
from rich.console import Console
from rich.markup import escape

from rover_rl.algos.evaluation.comparison import Disagreement, backends_of, disagreements_of, find_disagreements
from rover_rl.algos.evaluation.evaluate import EndlessEvaluation, Evaluation
from rover_rl.algos.evaluation.metrics import CONTACT_MEANING, CONTACT_METRICS, METRICS, Estimate
from rover_rl.algos.evaluation.results import worst_worlds
from rover_rl.algos.evaluation.tables import Column, print_columns
from rover_rl.files import write_json, written_whole

DEFAULT_COLUMNS = (
    "success_rate",
    "contact_free_success_rate",
    "spl",
    "mean_time_to_traverse",
    "goals_per_episode",
    "seconds_per_goal",
    "body_contact_share",
    *(key for key in METRICS if key.startswith("ending_")),
)
"""Metrics that tables show by default, as far as they are defined and the endings occur."""
LISTED = 20
"""Largest number of printed episodes on which backends disagree."""


def choose_columns(names: Sequence[str]) -> tuple[str, ...]:
    """Returns the metrics that :func:`print_table` shows, by their names in :data:`METRICS`.

    Args:
        names: names or headings of metrics; ``["all"]`` for all, none for :data:`DEFAULT_COLUMNS`.

    Raises:
        ValueError: for a name that is none of them.
    """
    if not names:
        return DEFAULT_COLUMNS
    if list(names) == ["all"]:
        return tuple(METRICS)
    known = {metric.heading: key for key, metric in METRICS.items()} | {key: key for key in METRICS}
    for name in names:
        if name not in known:
            headings = ", ".join(repr(m.heading) if " " in m.heading else m.heading for m in METRICS.values())
            raise ValueError(f"--columns takes all, or some of {headings}, got {name!r}")
    return tuple(dict.fromkeys(known[name] for name in names))


def print_table(
    evaluations: Sequence[Evaluation | EndlessEvaluation],
    console: Console | None = None,
    groups: Mapping[str, str] | None = None,
    columns: Sequence[str] = (),
) -> None:
    """Prints a table of policies for each world and mode, with 95 % confidence intervals below the values.

    Ranges of worlds share a table, in which each has a row. Below, the worlds with the lowest success rates. Policies
    in several backends have a row for each. Below, the first 20 episodes that reach their goal in one backend and not
    in another.

    Columns that do not fit the console follow in a further table. Names and numbers are never cut.

    Args:
        evaluations: evaluations to print, of any worlds and modes.
        console: console to print to; ``None``: standard output.
        groups: group name of each policy that belongs to a group, by the policy's name. Each group of several policies,
            such as those that differ in their seed only, has a row with its mean and standard deviation.
        columns: columns to show, as for :func:`choose_columns`.

    Raises:
        ValueError: for an unknown column.
    """
    chosen, console = choose_columns(columns), console or Console()
    shown: dict[str, None] = {}
    for title in dict.fromkeys(evaluation.title for evaluation in evaluations):
        together = [evaluation for evaluation in evaluations if evaluation.title == title]
        keys = [key for key in METRICS if key in chosen and _is_shown(key, together)]
        shown |= dict.fromkeys(keys)
        _print_together(console, title, together, groups or {}, keys)
    for evaluation in evaluations:
        if isinstance(evaluation, Evaluation) and evaluation.episodes.several_worlds:
            console.print(_worst_worlds(evaluation), highlight=False)
    if (disagreements := find_disagreements(evaluations)) is not None:
        _print_disagreements(disagreements, console)
    console.print(_legend(list(shown), evaluations), style="dim", highlight=False)


def _legend(keys: Sequence[str], evaluations: Sequence[Evaluation | EndlessEvaluation]) -> str:
    """Returns what the columns mean."""
    told = [f"{METRICS[key].heading}: {METRICS[key].meaning}" for key in keys if METRICS[key].meaning]
    if endings := [METRICS[key].heading for key in keys if not METRICS[key].meaning]:
        told.append(f"{', '.join(endings)}: episodes that end like this")
    estimates = (one.metrics[key] for one in evaluations for key in keys if key in one.metrics)
    intervals = any(not math.isnan(estimate.low) for estimate in estimates)
    legend = [escape("; ".join(told)) + "."]
    if any(key in CONTACT_METRICS for key in keys):
        legend.append(CONTACT_MEANING)
    if intervals:
        legend.append("Below each value: 95 % confidence interval.")
    return " ".join(legend)


def _worst_worlds(evaluation: Evaluation) -> str:
    """Returns a line with the worlds that have the lowest success rates."""
    worlds = {world["world"]: world for world in evaluation.by_world}
    worst = (worlds[index] for index in worst_worlds([evaluation]))
    named = ", ".join(f"{world['name']} {world['success_rate']:.0%}" for world in worst if world["success_rate"] < 1)
    policy = escape(f"{evaluation.name} in {evaluation.world_name}, {evaluation.backend}")
    return f"Lowest success rates of {policy}: {escape(named)}" if named else f"{policy}: all episodes reach their goal"


def _print_together(
    console: Console,
    title: str,
    evaluations: Sequence[Evaluation | EndlessEvaluation],
    groups: Mapping[str, str],
    keys: Sequence[str],
) -> None:
    """Prints a table with a row for each policy, world and backend, and for each group of policies."""
    backends = backends_of(evaluations)
    ranges = any(isinstance(one, Evaluation) and one.episodes.several_worlds for one in evaluations)

    def below(evaluation: Evaluation | EndlessEvaluation) -> tuple[str, ...]:
        return (*([evaluation.world_name] if ranges else []), *([evaluation.backend] if backends else []))

    first = {one.name: number for number, one in reversed([*enumerate(evaluations)])}
    order = sorted(evaluations, key=lambda one: first[one.name])
    names = [(one.name, *below(one)) for one in order]
    rows = [[_cell(key, one.metrics[key]) for key in keys] for one in order]
    for group, *place in dict.fromkeys((groups[one.name], *below(one)) for one in order if one.name in groups):
        members = [one for one in order if (groups.get(one.name), *below(one)) == (group, *place)]
        if len(members) > 1:
            names.append((group, f"{len(members)} policies", *place))
            rows.append([_mean_cell(key, [one.metrics[key].value for one in members]) for key in keys])
    cells = zip(*rows, strict=True)
    columns = [Column(METRICS[key].heading, METRICS[key].unit, column) for key, column in zip(keys, cells, strict=True)]
    print_columns(console, title, "policy", names, columns)


def _print_disagreements(disagreements: Sequence[Disagreement], console: Console) -> None:
    """Prints the first episodes on which backends disagree."""
    if not disagreements:
        console.print("The backends agree on which episodes reach their goal.")
        return
    listed = disagreements[:LISTED]
    columns = [
        Column("episode", "", [str(one.episode) for one in listed]),
        *(
            Column(heading, unit, [", ".join(f"{n:.2f}" for n in getattr(one, heading)) for one in listed])
            for heading, unit in (("start", "x, y, yaw"), ("goal", "x, y"))
        ),
    ]
    for backend in dict.fromkeys(backend for one in disagreements for backend in one.endings):
        columns.append(Column(backend, "", [one.endings.get(backend, "-") for one in listed], left=True))
    title = "Episodes that reach their goal in one backend and not in another"
    print_columns(console, title, "policy", [(one.policy, one.world) for one in listed], columns)
    if len(disagreements) > LISTED:
        console.print(f"{len(disagreements) - LISTED} more such episodes: see evaluation.json.")


def _is_shown(key: str, evaluations: Sequence[Evaluation | EndlessEvaluation]) -> bool:
    """Whether a metric has a column: false for undefined metrics and for endings that do not occur."""
    if key not in evaluations[0].metrics:
        return False
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
    return f"{_formatted(key, estimate.value)}\n{low}–{high}"


def _mean_cell(key: str, values: Sequence[float]) -> str:
    """Formats the mean of several policies and, below it, their standard deviation; ``-`` if a value is undefined."""
    mean, deviation = torch.tensor(values).mean().item(), torch.tensor(values).std().item()
    return "-" if math.isnan(mean) else f"{_formatted(key, mean)}\n± {_formatted(key, deviation)}"


def _formatted(key: str, value: float) -> str:
    """Formats a value in the unit of its column."""
    unit = METRICS[key].unit
    if unit == "%":
        return f"{100 * value:.1f}"
    return f"{value:.1f}" if unit == "s" else f"{value:.2f}"


def write_evaluation(path: Path, evaluations: Sequence[Evaluation | EndlessEvaluation]) -> None:
    """Writes evaluations as a JSON file with everything, and as CSV files.

    The CSV file of the same name has a row for each episode, the one whose name ends in ``-summary.csv`` a row for each
    evaluation, with all metrics and their intervals. Evaluations in several worlds also have a file with a row for each
    world, whose name ends in ``-worlds.csv``.

    Evaluations of a policy in several backends also list ``disagreements``: the episodes that reach their goal in one
    backend and not in another. The summary has their indices.

    Args:
        path: path of the JSON file.
        evaluations: evaluations to write, of any worlds and modes.
    """
    disagreements = [disagreements_of(evaluation, evaluations) for evaluation in evaluations]
    results = [
        evaluation.to_json() | ({} if found is None else {"disagreements": [one.to_json() for one in found]})
        for evaluation, found in zip(evaluations, disagreements, strict=True)
    ]
    write_json(path, results)
    write_rows(path.with_suffix(".csv"), [row for evaluation in evaluations for row in evaluation.rows()])
    rows: list[dict[str, Any]] = []
    for evaluation, found in zip(evaluations, disagreements, strict=True):
        row = evaluation.summary()
        if found is not None:
            row["disagreements"] = " ".join(str(one.episode) for one in found)
        for key, estimate in evaluation.metrics.items():
            row |= {key: estimate.value, f"{key}_low": estimate.low, f"{key}_high": estimate.high}
        rows.append(row)
    write_rows(path.with_name(f"{path.stem}-summary.csv"), rows)
    by_world = [
        {"policy": one.name, "backend": one.backend, "worlds": one.world_name, **world}
        for one in evaluations
        if isinstance(one, Evaluation) and one.episodes.several_worlds
        for world in one.by_world
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
