"""Evaluation reports: tables on the terminal, JSON and CSV files."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TypeAlias

import torch
from rich.console import Console
from rich.markup import escape

from rover_rl.algos.evaluation.metrics import ENDING, METRICS, Estimate, ratio
from rover_rl.algos.evaluation.results import Evaluation, worst_worlds
from rover_rl.algos.evaluation.tables import Column, cell, estimate_row, formatted, print_tables, write_rows
from rover_rl.files import MADE_BY, write_json
from rover_rl.registry import perhaps

ALL_COLUMNS = "all"  # in place of the names of columns: all metrics
LISTED = 20  # largest number of printed episodes on which backends disagree
_Row: TypeAlias = tuple[str, dict[str, str]]
"""Row of a table: a name, with a note in its second line, and the cell of each metric."""


def print_table(
    evaluations: Sequence[Evaluation],
    console: Console | None = None,
    groups: Mapping[str, str] | None = None,
    columns: Sequence[str] = (),
) -> None:
    """Prints a table of policies for each world and mode, with 95 % confidence intervals below the values.

    Columns that do not fit into the width of the terminal, by default 80, go into a further table. Below, for ranges of
    worlds, the worlds with the lowest success rates, and for policies in several backends, the episodes that reach
    their goal in one backend and not in another. A last paragraph explains the columns.

    Args:
        groups: group name of each policy that belongs to a group, by the policy's name. Each group of several policies,
            such as those that differ in their seed only, has a row with its mean and standard deviation.
        columns: names or headings of metrics, or ``"all"``; empty: success, contacts, SPL, time and endings.

    Raises:
        ValueError: for an unknown column.
    """
    console = console or Console()
    chosen, shown, grouped = check_columns(columns), dict[str, None](), False
    for title in dict.fromkeys(evaluation.title for evaluation in evaluations):
        together = [evaluation for evaluation in evaluations if evaluation.title == title]
        keys = [key for key in chosen if _is_shown(key, together)]
        means = _group_rows(together, groups or {})
        rows = [*_rows(together), *means]
        cells = [
            Column(METRICS[key].heading, METRICS[key].unit, [row.get(key, "-") for _, row in rows]) for key in keys
        ]
        print_tables(title, [name for name, _ in rows], cells, console)
        shown |= dict.fromkeys(keys)
        grouped |= bool(means)
        _print_imperfections(title, together, console)
    for evaluation in evaluations:
        if evaluation.episodes.several_worlds:
            console.print(_worst_worlds(evaluation), highlight=False, soft_wrap=True)
    for line in _disagreements(evaluations):
        console.print(escape(line), highlight=False, soft_wrap=True)
    console.print(_legend([*shown], evaluations, grouped), style="dim", highlight=False)


def check_columns(names: Sequence[str]) -> list[str]:
    """Returns the metrics that names of columns stand for, in the order of the table."""
    if ALL_COLUMNS in names:
        return [*METRICS]
    if not names:
        return [key for key, metric in METRICS.items() if metric.default]
    known = {metric.heading: key for key, metric in METRICS.items()} | {key: key for key in METRICS}
    for name in names:
        if name not in known:
            known_names = f"use {ALL_COLUMNS} or some of {[*METRICS]}"
            raise ValueError(f"unknown column {name!r}{perhaps(name, known)}; {known_names}")
    chosen = {known[name] for name in names}
    return [key for key in METRICS if key in chosen]


def _is_shown(key: str, evaluations: Sequence[Evaluation]) -> bool:
    values = [evaluation.metrics[key].value for evaluation in evaluations if key in evaluation.metrics]
    return any(value > 0 for value in values) or not (key.startswith(ENDING) or all(map(math.isnan, values)))


def _rows(evaluations: Sequence[Evaluation]) -> list[_Row]:
    several = _several_backends(evaluations)
    order = [*dict.fromkeys(evaluation.name for evaluation in evaluations)]
    return [
        (_labeled(one.name, one, several), {k: _cell(k, e) for k, e in one.metrics.items()})
        for one in sorted(evaluations, key=lambda one: order.index(one.name))
    ]


def _labeled(name: str, one: Evaluation, several_backends: bool, note: str = "") -> str:
    notes = [note, one.backend if several_backends else "", one.imperfection]
    return "\n".join(filter(None, (name, ", ".join(filter(None, notes)))))


def _cell(key: str, estimate: Estimate) -> str:
    shown = Estimate(estimate.value, math.nan, math.nan) if key.startswith(ENDING) else estimate
    return cell(shown, METRICS[key].unit)


def _group_rows(evaluations: Sequence[Evaluation], groups: Mapping[str, str]) -> list[_Row]:
    found: dict[tuple[str, str, str], list[Evaluation]] = {}
    for one in evaluations:
        if one.name in groups:
            found.setdefault((groups[one.name], one.backend, one.imperfection), []).append(one)
    several, rows = _several_backends(evaluations), []
    for (group, *_), members in found.items():
        if len(members) > 1:
            cells = {key: _mean_cell(key, [one.metrics[key].value for one in members]) for key in members[0].metrics}
            rows.append((_labeled(group, members[0], several, f"{len(members)} policies"), cells))
    return rows


def _mean_cell(key: str, values: Sequence[float]) -> str:
    mean, deviation = torch.tensor(values).mean().item(), torch.tensor(values).std().item()
    unit = METRICS[key].unit
    return "-" if math.isnan(mean) else f"{formatted(mean, unit)}\n± {formatted(deviation, unit)}"


def _several_backends(evaluations: Sequence[Evaluation]) -> bool:
    places = {(evaluation.name, evaluation.backend) for evaluation in evaluations}
    return len(places) > len({name for name, _ in places})


def _worst_worlds(evaluation: Evaluation) -> str:
    worlds = {world["world"]: world for world in evaluation.by_world}
    worst = (worlds[index] for index in worst_worlds([evaluation]))
    named = ", ".join(f"{world['name']} {world['success_rate']:.0%}" for world in worst if world["success_rate"] < 1)
    places = (evaluation.world_name, evaluation.backend, evaluation.imperfection)
    policy = escape(f"{evaluation.name} in {', '.join(filter(None, places))}")
    return f"Lowest success rates of {policy}: {escape(named)}" if named else f"{policy}: all episodes reach their goal"


def _legend(shown: Sequence[str], evaluations: Sequence[Evaluation], grouped: bool) -> str:
    said = [f"{METRICS[key].heading}: {METRICS[key].meaning}" for key in shown if METRICS[key].meaning]
    endings = [METRICS[key].heading for key in shown if key.startswith(ENDING)]
    said += [f"{', '.join(endings)}: episodes that end so"] if endings else []
    intervals = any(not math.isnan(one.metrics[key].low) for one in evaluations for key in shown if key in one.metrics)
    below = ["95 % confidence interval"] * intervals + ["± standard deviation of several policies"] * grouped
    return "; ".join(said) + (f". Below a value: {', '.join(below)}." if below else ".")


def write_evaluation(path: Path, evaluations: Sequence[Evaluation]) -> None:
    """Writes evaluations as a JSON file with everything, such as ``evaluation.json``, and as CSV files beside it.

    ``evaluation.csv`` has a row for each episode, ``evaluation-summary.csv`` a row for each evaluation with all
    metrics and their intervals, and with several worlds, ``evaluation-worlds.csv`` a row for each world.
    """
    results, summaries, by_world = [], [], []
    for one in evaluations:
        results.append(MADE_BY | one.to_json())
        summaries.append(one.summary() | estimate_row(one.metrics))
        if one.episodes.several_worlds:
            head = {"policy": one.name, "backend": one.backend, "worlds": one.world_name}
            by_world += [head | world for world in one.by_world]
    write_json(path, results)
    write_rows(path.with_suffix(".csv"), [row for one in evaluations for row in one.episode_rows()])
    write_rows(path.with_name(f"{path.stem}-summary.csv"), summaries)
    if by_world:
        write_rows(path.with_name(f"{path.stem}-worlds.csv"), by_world)


def _disagreements(evaluations: Sequence[Evaluation]) -> Iterator[str]:
    """Tells which episodes of a policy reach their goal in one backend and not in another."""
    groups: dict[tuple[object, ...], dict[str, Evaluation]] = {}
    for one in evaluations:
        if not one.endless:
            same = one.name, one.imperfection, one.action_repeat, one.seconds, id(one.episodes)
            groups.setdefault(same, {})[one.backend] = one
    for by_backend in (group for group in groups.values() if len(group) > 1):
        name, endings = (
            next(iter(by_backend.values())).name,
            zip(*(one.endings for one in by_backend.values()), strict=True),
        )
        differ = {number: each for number, each in enumerate(endings) if 0 < each.count("goal") < len(each)}
        told = [
            f"{number} ({', '.join(map(' '.join, zip(by_backend, each, strict=True)))})"
            for number, each in differ.items()
        ]
        more = f" and {len(told) - LISTED} more" if len(told) > LISTED else ""
        which = f"Reach their goal in one backend and not in another: episodes {', '.join(told[:LISTED])}{more}"
        yield f"{name}: {which}" if told else f"{name}: the backends agree on which episodes reach their goal"


def _print_imperfections(title: str, evaluations: Sequence[Evaluation], console: Console) -> None:
    driven = [one for one in evaluations if not one.endless]
    names = [*dict.fromkeys(one.imperfection for one in driven)]
    if len(names) < 2:
        return
    rows: dict[tuple[str, str], dict[str, Evaluation]] = {}
    for one in driven:
        rows.setdefault((one.name, one.backend), {})[one.imperfection] = one
    several = len({backend for _, backend in rows}) > 1
    policies = [f"{name}, {backend}" if several else name for name, backend in rows]
    columns = []
    for name in names:
        cells: list[str] = []
        for row in rows.values():
            mine, exact = row.get(name), row.get(names[0])
            cells.append("-" if mine is None else cell(mine.metrics["success_rate"], "%"))
            cells.append(cell(change(mine, exact), "%") if mine and exact and mine is not exact else "-")
        columns.append(Column(name, "%", cells))
    heading = f"{title}. Success, and its change against {names[0]}"
    print_tables(heading, [line for policy in policies for line in (policy, "change")], columns, console)


def change(one: Evaluation, other: Evaluation) -> Estimate:
    """Computes how much larger the success rate of ``one`` is, on the same episodes, with its bootstrap interval."""
    return ratio((one.reached.double() - other.reached.double()).tolist())
