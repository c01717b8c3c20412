r"""Tables of policies that fit into the terminal: columns that do not fit go into another table below."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.table import Table
from rich.text import Text

NAME_WIDTH = 30
"""Width up to which names of policies stay in one line if there is room, characters."""
LEAST_NAME_WIDTH = 12
"""Width of the names in a narrow terminal, characters."""
_HEADING_WIDTH = 16
"""Largest width of a heading, characters."""
_UNLIMITED = 100_000
"""Width of a terminal in which everything fits, characters."""


@dataclass(frozen=True)
class Column:
    """A column of a table.

    Attributes:
        heading: name of the quantity.
        unit: its unit; empty if it has none.
        cells: text of each row. A second line, such as a confidence interval, is dimmed.
    """

    heading: str
    unit: str
    cells: Sequence[str]


def fitting_tables(title: str, names: Sequence[str], columns: Sequence[Column], console: Console) -> list[Table | Text]:
    """Returns a title, and tables that together have all columns, none of them wider than the console.

    Names that are too long continue in the next line, after a separator such as ``-``. Headings of several words have a
    line for each. Nothing else is broken or cut.

    Args:
        title: what stands above the tables.
        names: names of the rows. Lines after the first, such as a backend, are dimmed.
        columns: columns beside the names.
        console: console whose width the tables have at most.
    """
    tables: list[Table | Text] = [Text(title, "bold")]
    rest = [*columns]
    while rest or len(tables) == 1:
        count = max(1, next((n for n in range(len(rest), 0, -1) if _fits(names, rest[:n], console)), 0))
        width = max(_name_width(names, rest[:count], console), LEAST_NAME_WIDTH)
        tables.append(_table(names, rest[:count], width))
        rest = rest[count:]
    return tables


def _fits(names: Sequence[str], columns: Sequence[Column], console: Console) -> bool:
    longest = max(len(line) for name in names for line in name.splitlines())
    return _name_width(names, columns, console) >= min(longest, LEAST_NAME_WIDTH)


def _name_width(names: Sequence[str], columns: Sequence[Column], console: Console) -> int:
    """Returns the width that the columns leave for the names, at most what the names need."""
    longest = max(len(line) for name in names for line in name.splitlines())
    without = _table([""] * len(names), columns, 0)
    needed = console.measure(without, options=console.options.update(width=_UNLIMITED)).maximum - len("policy")
    return min(max(longest, len("policy")), NAME_WIDTH, console.width - needed)


def _table(names: Sequence[str], columns: Sequence[Column], name_width: int) -> Table:
    table = Table(box=SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False)
    table.add_column("policy", no_wrap=True)
    for column in columns:
        heading = "\n".join(line for word in column.heading.split() for line in folded(word, _HEADING_WIDTH))
        table.add_column(f"{escape(heading)}\n{column.unit}", justify="right", no_wrap=True, vertical="top")
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
