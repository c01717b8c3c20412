"""Reports of evaluations: tables that fit into the terminal, JSON and CSV files."""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from rover_rl.algos.evaluation.metrics import ENDING, METRICS, Estimate, ratio
from rover_rl.algos.evaluation.results import Evaluation, worst_worlds
from rover_rl.files import MADE_BY, write_json, written_whole
from rover_rl.registry import perhaps

NAME_WIDTH = 30  # width up to which names of policies stay in one line if there is room, characters
LEAST_NAME_WIDTH = 12  # width of the names in a narrow terminal, characters
HEADING_WIDTH = 16  # largest width of a heading, characters
ALL_COLUMNS = "all"  # in place of the names of columns: all metrics
LISTED = 20  # largest number of printed episodes on which backends disagree


def print_table(
    evaluations: Sequence[Evaluation],
    console: Console | None = None,
    groups: Mapping[str, str] | None = None,
    columns: Sequence[str] = (),
) -> None:
    """Prints a table of policies for each world and mode, with 95 % confidence intervals below the values.

    Columns that do not fit into the width of the terminal go into a further table. Below are, for ranges of worlds, the
    worlds with the lowest success rates, and for policies in several backends, the episodes that reach their goal in
    one backend and not in another. A last paragraph explains the columns.

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
        names, rows = zip(*_rows(together, groups or {}), strict=True)
        cells = [Column(METRICS[key].heading, METRICS[key].unit, [row.get(key, "-") for row in rows]) for key in keys]
        print_tables(title, names, cells, console)
        shown |= dict.fromkeys(keys)
        grouped |= len(rows) > len(together)
        _print_imperfections(title, together, console)
    for evaluation in evaluations:
        if evaluation.episodes.several_worlds:
            console.print(_worst_worlds(evaluation), highlight=False, soft_wrap=True)
    for line in _disagreements(evaluations):
        console.print(escape(line), highlight=False, soft_wrap=True)
    console.print(_legend([*shown], evaluations, grouped), style="dim", highlight=False)


def check_columns(names: Sequence[str]) -> list[str]:
    """Metrics that names of columns stand for, in the order of the table."""
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


def _rows(evaluations: Sequence[Evaluation], groups: Mapping[str, str]) -> list[tuple[str, dict[str, str]]]:
    """Names (with a note in the second line) and cells of policies, in their order, and of groups of several."""
    several = len({(one.name, one.backend) for one in evaluations}) > len({one.name for one in evaluations})

    def label(name: str, one: Evaluation, note: str = "") -> str:
        notes = [note, one.backend if several else "", one.imperfection]
        return "\n".join(filter(None, (name, ", ".join(filter(None, notes)))))

    order = [*dict.fromkeys(one.name for one in evaluations)]
    found: dict[tuple[str, ...], list[Evaluation]] = {}
    rows = []
    for one in sorted(evaluations, key=lambda one: order.index(one.name)):
        rows.append((label(one.name, one), {key: _cell(key, estimate) for key, estimate in one.metrics.items()}))
        if one.name in groups:
            found.setdefault((groups[one.name], one.backend, one.imperfection), []).append(one)
    for (group, *_), members in found.items():
        if len(members) > 1:
            cells = {key: _mean_cell(key, [one.metrics[key].value for one in members]) for key in members[0].metrics}
            rows.append((label(group, members[0], f"{len(members)} policies"), cells))
    return rows


def _cell(key: str, estimate: Estimate) -> str:
    """Formats a value with its interval, and an ending without."""
    text = cell(estimate, METRICS[key].unit)
    return text.splitlines()[0] if key.startswith(ENDING) else text


def _mean_cell(key: str, values: Sequence[float]) -> str:
    mean, deviation = torch.tensor(values).mean().item(), torch.tensor(values).std().item()
    unit = METRICS[key].unit
    return "-" if math.isnan(mean) else f"{_formatted(mean, unit)}\n± {_formatted(deviation, unit)}"


def _worst_worlds(evaluation: Evaluation) -> str:
    worlds = {world["world"]: world for world in evaluation.by_world}
    worst = (worlds[index] for index in worst_worlds([evaluation]))
    named = ", ".join(f"{world['name']} {world['success_rate']:.0%}" for world in worst if world["success_rate"] < 1)
    places = (evaluation.episodes.name, evaluation.backend, evaluation.imperfection)
    policy = escape(f"{evaluation.name} in {', '.join(filter(None, places))}")
    return f"Lowest success rates of {policy}: {escape(named)}" if named else f"{policy}: all episodes reach their goal"


def _legend(shown: Sequence[str], evaluations: Sequence[Evaluation], grouped: bool) -> str:
    said = [f"{METRICS[key].heading}: {METRICS[key].meaning}" for key in shown if METRICS[key].meaning]
    endings = [METRICS[key].heading for key in shown if key.startswith(ENDING)]
    said += [f"{', '.join(endings)}: episodes that end so"] if endings else []
    intervals = any(not math.isnan(one.metrics[key].low) for one in evaluations for key in shown if key in one.metrics)
    below = ["95 % confidence interval"] * intervals + ["± standard deviation of several policies"] * grouped
    return "; ".join(said) + (f". Below a value: {', '.join(below)}." if below else ".")


def _disagreements(evaluations: Sequence[Evaluation]) -> Iterator[str]:
    """Tells which episodes of a policy reach their goal in one backend and not in another."""
    groups: dict[tuple[object, ...], dict[str, Evaluation]] = {}
    for one in evaluations:
        if not one.endless:
            same = one.name, one.imperfection, one.action_repeat, one.seconds, id(one.episodes)
            groups.setdefault(same, {})[one.backend] = one
    for (name, *_), by_backend in groups.items():
        if len(by_backend) == 1:
            continue
        differ = []
        for number, endings in enumerate(zip(*(one.endings for one in by_backend.values()), strict=True)):
            if 0 < endings.count("goal") < len(endings):
                differ.append(f"{number} ({', '.join(map(' '.join, zip(by_backend, endings, strict=True)))})")
        more = f" and {len(differ) - LISTED} more" if len(differ) > LISTED else ""
        which = f"Reach their goal in one backend and not in another: episodes {', '.join(differ[:LISTED])}{more}"
        yield f"{name}: {which if differ else 'the backends agree on which episodes reach their goal'}"


def _print_imperfections(title: str, evaluations: Sequence[Evaluation], console: Console) -> None:
    rows: dict[str, dict[str, Evaluation]] = {}
    several = len({one.backend for one in evaluations}) > 1
    for one in evaluations:
        if not one.endless:
            rows.setdefault(f"{one.name}, {one.backend}" if several else one.name, {})[one.imperfection] = one
    names = [*dict.fromkeys(name for row in rows.values() for name in row)]
    if len(names) < 2:
        return
    columns = []
    for name in names:
        cells: list[str] = []
        for row in rows.values():
            mine, exact = row.get(name), row.get(names[0])
            cells.append("-" if mine is None else cell(mine.metrics["success_rate"], "%"))
            cells.append(cell(change(mine, exact), "%") if mine and exact and mine is not exact else "-")
        columns.append(Column(name, "%", cells))
    heading = f"{title}. Success, and its change against {names[0]}"
    print_tables(heading, [line for policy in rows for line in (policy, "change")], columns, console)


def change(one: Evaluation, other: Evaluation) -> Estimate:
    """How much larger the success rate of ``one`` is, on the same episodes, with its bootstrap interval."""
    return ratio((one.reached.double() - other.reached.double()).tolist())


class Column(NamedTuple):
    """A column of a table. The second line of a cell, such as a confidence interval, is dimmed."""

    heading: str
    unit: str
    cells: Sequence[str]


def print_tables(
    title: str, names: Sequence[str], columns: Sequence[Column], console: Console, heading: str = "policy"
) -> None:
    """Prints a title, and tables that together have all columns, none of them wider than the console.

    Long names continue in the next line, after a separator such as ``-``. Nothing else is broken or cut.
    """
    console.print(Text(title, "bold"))
    longest, rest = max(len(heading), *(len(line) for name in names for line in name.splitlines())), [*columns]
    while True:
        rooms = {count: _room(len(names), rest[:count], console) for count in range(len(rest), 0, -1)}
        count = next((count for count, room in rooms.items() if room >= min(longest, LEAST_NAME_WIDTH)), 1)
        width = min(longest, NAME_WIDTH, rooms.get(count, NAME_WIDTH))
        console.print(_table(names, rest[:count], max(width, LEAST_NAME_WIDTH), heading))
        rest = rest[count:]
        if not rest:
            return


def _room(rows: int, columns: Sequence[Column], console: Console) -> int:
    """Width that columns leave to the names, characters."""
    without, unlimited = _table([""] * rows, columns, 0, "policy"), console.options.update(width=100_000)
    return console.width - console.measure(without, options=unlimited).maximum + len("policy")


def _table(names: Sequence[str], columns: Sequence[Column], name_width: int, heading: str) -> Table:
    table = Table(box=SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False)
    table.add_column(heading, no_wrap=True)
    for title, unit, _ in columns:
        lines = [line for word in title.split() for line in _folded(word, HEADING_WIDTH)]
        table.add_column("\n".join((escape("\n".join(lines)), unit)), justify="right", no_wrap=True, vertical="top")
    for name, *cells in zip(names, *(column.cells for column in columns), strict=True):
        first, *others = name.splitlines() or [""]
        label = [escape(part) for part in _folded(first, name_width)]
        label += [f"[dim]{escape(part)}[/dim]" for line in others for part in _folded(line, name_width)]
        table.add_row("\n".join(label), *map(_dimmed, cells))
    return table


def _dimmed(cell: str) -> str:
    value, *below = cell.splitlines()
    return "\n".join([value, *(f"[dim]{line}[/dim]" for line in below)])


def _folded(name: str, width: int) -> list[str]:
    """Divides a name into lines of at most ``width`` characters, after separators; a part that is longer is divided."""
    lines = [""]
    for part in re.findall(r"[^-_:/.,@ ]*[-_:/.,@ ]+|[^-_:/.,@ ]+$", name):
        if lines[-1] and len(lines[-1]) + len(part.rstrip()) > width:
            lines.append("")
        lines[-1] += part
        while width > 0 and len(lines[-1].rstrip()) > width:
            lines[-1:] = [lines[-1][:width], lines[-1][width:]]
    return [line.rstrip() for line in lines]


def cell(estimate: Estimate, unit: str, digits: int = 2) -> str:
    """Formats a value and, below it, its confidence interval; ``-`` for an undefined value.

    Proportions (``"%"``) have one digit and their ends none, seconds one digit, and other values ``digits``.
    """
    if math.isnan(estimate.value):
        return "-"
    value = _formatted(estimate.value, unit, digits)
    if math.isnan(estimate.low):
        return value
    ends = (estimate.low, estimate.high)
    low, high = (f"{100 * end:.0f}" if unit == "%" else _formatted(end, unit, digits) for end in ends)
    return f"{value}\n{low}–{high}"


def _formatted(value: float, unit: str, digits: int = 2) -> str:
    return f"{100 * value:.1f}" if unit == "%" else f"{value:.{1 if unit == 's' else digits}f}"


def write_evaluation(path: Path, evaluations: Sequence[Evaluation]) -> None:
    """Writes evaluations as a JSON file with everything, such as ``evaluation.json``, and as CSV files beside it.

    ``evaluation.csv`` has a row for each episode, ``evaluation-summary.csv`` a row for each evaluation with all
    metrics and their intervals, and with several worlds, ``evaluation-worlds.csv`` a row for each world.
    """
    write_json(path, [MADE_BY | one.to_json() for one in evaluations])
    write_rows(path.with_suffix(".csv"), [row for one in evaluations for row in one.episode_rows()])
    summaries = [one.summary() | estimate_row(one.metrics) for one in evaluations]
    write_rows(path.with_name(f"{path.stem}-summary.csv"), summaries)
    by_world = []
    for one in (one for one in evaluations if one.episodes.several_worlds):
        head = {"policy": one.name, "backend": one.backend, "worlds": one.episodes.name}
        by_world += [head | world for world in one.by_world]
    if by_world:
        write_rows(path.with_name(f"{path.stem}-worlds.csv"), by_world)


def write_rows(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Writes rows as CSV, with a column for each key that occurs in them."""
    first, *others = dict.fromkeys(key for row in rows for key in row) or ("",)
    with written_whole(path) as temporary, temporary.open("w", newline="") as file:
        # The quotes are the mark of a table: see rover_rl.files.
        file.write(",".join((f'"{first}"', *others)) + "\r\n")
        csv.DictWriter(file, [first, *others]).writerows(rows)


def estimate_row(estimates: Mapping[str, Estimate]) -> dict[str, float]:
    columns: dict[str, float] = {}
    for key, estimate in estimates.items():
        columns |= {key: estimate.value, f"{key}_low": estimate.low, f"{key}_high": estimate.high}
    return columns
