"""Tables that fit the width of the console: whole numbers and names, and a further table for what does not fit."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

from rich.box import SIMPLE_HEAD
from rich.cells import cell_len
from rich.console import Console
from rich.table import Table
from rich.text import Text

_LABEL = 16
"""Width to which the names of the rows are folded if a table is too wide."""
_DIM = "dim"


@dataclass(frozen=True)
class Column:
    """A column of a table.

    Attributes:
        heading: heading. It is folded at spaces.
        unit: unit below the heading; may be empty.
        cells: a cell for each row, of one or several lines. All lines but the first are dim.
        left: whether the column is aligned to the left.
    """

    heading: str
    unit: str
    cells: Sequence[str]
    left: bool = False

    @property
    def width(self) -> int:
        """Number of characters of the longest line."""
        lines = (*self.heading.split(), self.unit, *(line for cell in self.cells for line in cell.split("\n")))
        return max(map(cell_len, lines))


def print_columns(
    console: Console, title: str, corner: str, names: Sequence[Sequence[str]], columns: Sequence[Column]
) -> None:
    """Prints a table, or several below one another if the columns do not fit beside one another.

    Args:
        console: console to print to.
        title: title above the table.
        corner: heading of the names.
        names: name of each row, and lines in dim type below it.
        columns: columns right of the names.
    """
    console.print()
    console.print(Text(title, "italic"))
    gap = 2
    for gap in (2, 1):
        label = min(_longest(names), console.width - sum(gap + column.width for column in columns))
        if label >= _LABEL or label >= _longest(names):
            break
    else:
        label = _LABEL
    folded = [[fold(line, label) for line in lines] for lines in names]
    label = max(cell_len(part) for lines in [[corner.split()], *folded] for line in lines for part in line)
    for several in _packed(columns, console.width - label, gap):
        table = Table(box=SIMPLE_HEAD, padding=0, show_edge=False, pad_edge=False)
        table.add_column("\n".join(corner.split()), no_wrap=True, min_width=label)
        for column in several:
            heading = "\n".join((*column.heading.split(), column.unit))
            justify = "left" if column.left else "right"
            table.add_column(Text(heading), justify=justify, no_wrap=True, min_width=column.width + gap - 1)
        for row, (name, *below) in enumerate(folded):
            first = Text("\n".join(name)).append("".join(f"\n{part}" for line in below for part in line), _DIM)
            table.add_row(first, *(_text(column.cells[row]) for column in several))
        table.width = label + sum(gap + column.width for column in several)
        console.print(table, crop=False, highlight=False)


def fold(name: str, width: int) -> list[str]:
    """Folds a name after separators, so that its lines have at most ``width`` characters if its parts have.

    Example:
        >>> fold("my-long-run-name-with-seed-12", 16)
        ['my-long-run-', 'name-with-', 'seed-12']
    """
    lines = [""]
    for part in re.findall(r"[^-_/:, ]*[-_/:, ]*", name):
        if lines[-1] and cell_len(lines[-1] + part.rstrip()) > width:
            lines.append("")
        lines[-1] += part
    return [line.rstrip() for line in lines]


def _longest(names: Sequence[Sequence[str]]) -> int:
    return max((cell_len(line) for lines in names for line in lines), default=0)


def _packed(columns: Sequence[Column], width: int, gap: int) -> list[list[Column]]:
    """Divides columns into groups that are at most ``width`` wide, each of at least one column."""
    groups: list[list[Column]] = [[]]
    for column in columns:
        used = sum(gap + one.width for one in groups[-1])
        if groups[-1] and used + gap + column.width > width:
            groups.append([])
        groups[-1].append(column)
    return groups


def _text(cell: str) -> Text:
    first, *below = cell.split("\n")
    return Text(first).append("".join(f"\n{line}" for line in below), _DIM)
