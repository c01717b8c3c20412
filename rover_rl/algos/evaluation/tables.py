"""Tables that fit the width of the console: whole numbers and names, and a further table for what does not fit."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from textwrap import wrap

from rich.box import SIMPLE_HEAD
from rich.cells import cell_len
from rich.console import Console
from rich.table import Table
from rich.text import Text

_LABEL = 16
"""Width to which the names of the rows are folded if a table is too wide."""
_GAPS = (2, 1)
"""Spaces between columns: the first number with which a table fits."""
_INDENT = "  "
"""Indentation of what is below a name."""


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
    names = [[name, *(_INDENT + line for line in below)] for name, *below in names]
    longest = max((cell_len(line) for lines in names for line in lines), default=0)
    for gap in _GAPS:
        label = min(longest, console.width - sum(gap + column.width for column in columns))
        if label >= min(longest, _LABEL):
            break
    else:
        label, gap = min(longest, _LABEL), max(_GAPS)
    folded = [[part for line in lines for part in fold(line, label)] for lines in names]
    label = max(cell_len(part) for part in (corner, *(part for lines in folded for part in lines)))
    for several in _packed(columns, console.width - label, gap):
        table = Table(box=SIMPLE_HEAD, padding=(0, 0, 0, gap - 1), show_edge=False, pad_edge=False)
        table.add_column(corner, no_wrap=True, min_width=label, vertical="top")
        for column in several:
            heading = "\n".join((*wrap(column.heading, column.width), column.unit))
            justify = "left" if column.left else "right"
            table.add_column(Text(heading), justify=justify, no_wrap=True, min_width=column.width)
        for row, (lines, (name, *_)) in enumerate(zip(folded, names, strict=True)):
            table.add_row(
                _text(lines, bright=len(fold(name, label))),
                *(_text(column.cells[row].split("\n"), bright=1) for column in several),
            )
        table.width = label + sum(gap + column.width for column in several)
        console.print(table, crop=False, highlight=False)


def fold(name: str, width: int) -> list[str]:
    """Folds a name after separators, so that its lines have at most ``width`` characters if its parts have.

    Example:
        >>> fold("my-long-run-name-with-seed-12", 16)
        ['my-long-run-', 'name-with-', 'seed-12']
    """
    indent = name[: len(name) - len(name.lstrip())]
    lines = [indent]
    for part in re.findall(r"[^-_/:, ]*[-_/:, ]*", name.lstrip()):
        if lines[-1].strip() and cell_len(lines[-1] + part.rstrip()) > width:
            lines.append(indent)
        lines[-1] += part
    return [line.rstrip() for line in lines]


def _packed(columns: Sequence[Column], width: int, gap: int) -> list[list[Column]]:
    """Divides columns into groups that are at most ``width`` wide, each of at least one column."""
    groups: list[list[Column]] = [[]]
    for column in columns:
        used = sum(gap + one.width for one in groups[-1])
        if groups[-1] and used + gap + column.width > width:
            groups.append([])
        groups[-1].append(column)
    return groups


def _text(lines: Sequence[str], bright: int) -> Text:
    """Lines of a cell, dim except for the first ``bright`` ones."""
    return Text("\n").join(Text(line, "dim" if number >= bright else "") for number, line in enumerate(lines))
