"""Tables that fit into the terminal: columns that do not fit go into another table below. Tables as CSV files."""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from rover_rl.algos.evaluation.metrics import Estimate
from rover_rl.files import written_whole

NAME_WIDTH = 30  # width up to which names of policies stay in one line if there is room, characters
LEAST_NAME_WIDTH = 12  # width of the names in a narrow terminal, characters
_HEADING_WIDTH = 16  # largest width of a heading, characters
_UNLIMITED = 100_000  # width of a terminal in which everything fits, characters


@dataclass(frozen=True)
class Column:
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
    longest = max(len(heading), *(len(line) for name in names for line in name.splitlines()))
    rest = [*columns]
    while True:
        rooms = {count: _room(len(names), rest[:count], console) for count in range(len(rest), 0, -1)}
        count = next((count for count, room in rooms.items() if room >= min(longest, LEAST_NAME_WIDTH)), 1)
        width = min(longest, NAME_WIDTH, rooms.get(count, NAME_WIDTH))
        console.print(_table(names, rest[:count], max(width, LEAST_NAME_WIDTH), heading))
        rest = rest[count:]
        if not rest:
            return


def cell(estimate: Estimate, unit: str, digits: int = 2) -> str:
    """Formats a value and, below it, its confidence interval; ``-`` for an undefined value.

    Proportions (``"%"``) have one digit and their ends none, seconds one digit, and other values ``digits``.
    """
    if math.isnan(estimate.value):
        return "-"
    value = formatted(estimate.value, unit, digits)
    if math.isnan(estimate.low):
        return value
    ends = (estimate.low, estimate.high)
    low, high = (f"{100 * end:.0f}" if unit == "%" else formatted(end, unit, digits) for end in ends)
    return f"{value}\n{low}–{high}"


def formatted(value: float, unit: str, digits: int = 2) -> str:
    return f"{100 * value:.1f}" if unit == "%" else f"{value:.{1 if unit == 's' else digits}f}"


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


def finite_row(row: Mapping[str, Any]) -> dict[str, Any]:
    """Returns a row with ``None`` in place of nan and infinity, which JSON does not know."""
    return {key: None if isinstance(n, float) and not math.isfinite(n) else n for key, n in row.items()}


def _room(rows: int, columns: Sequence[Column], console: Console) -> int:
    without = _table([""] * rows, columns, 0, "policy")
    needed = console.measure(without, options=console.options.update(width=_UNLIMITED)).maximum
    return console.width - needed + len("policy")


def _table(names: Sequence[str], columns: Sequence[Column], name_width: int, heading: str) -> Table:
    table = Table(box=SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False)
    table.add_column(heading, no_wrap=True)
    for column in columns:
        title = "\n".join(line for word in column.heading.split() for line in folded(word, _HEADING_WIDTH))
        table.add_column(f"{escape(title)}\n{column.unit}", justify="right", no_wrap=True, vertical="top")
    for number, name in enumerate(names):
        first, *others = name.splitlines() or [""]
        lines = [escape(part) for part in folded(first, name_width)]
        lines += [f"[dim]{escape(part)}[/dim]" for line in others for part in folded(line, name_width)]
        table.add_row("\n".join(lines), *(_dimmed(column.cells[number]) for column in columns))
    return table


def _dimmed(cell: str) -> str:
    value, *below = cell.splitlines()
    return "\n".join([value, *(f"[dim]{line}[/dim]" for line in below)])


def folded(name: str, width: int) -> list[str]:
    """Divides a name into lines of at most ``width`` characters, after separators; a part that is longer is divided."""
    lines = [""]
    for part in re.findall(r"[^-_:/.,@ ]*[-_:/.,@ ]+|[^-_:/.,@ ]+$", name):
        if lines[-1] and len(lines[-1]) + len(part.rstrip()) > width:
            lines.append("")
        lines[-1] += part
        while width > 0 and len(lines[-1].rstrip()) > width:
            lines[-1:] = [lines[-1][:width], lines[-1][width:]]
    return [line.rstrip() for line in lines]
