"""Covers of cells by few rectangles."""

from __future__ import annotations

import numpy as np


def cover(cells: np.ndarray) -> list[tuple[int, int, int, int]]:
    """Covers the true cells of a grid by few rectangles ``(row, column, rows, columns)`` that do not overlap.

    Takes the best of three covers: equal runs of consecutive rows, equal runs of consecutive columns, and greedily the
    larger of the widest and the tallest rectangle at each cell.
    """
    along = _joined_runs(cells)
    across = [(row, column, rows, columns) for column, row, columns, rows in _joined_runs(cells.T)]
    return min(along, across, _maximal(cells), key=len)


def _joined_runs(cells: np.ndarray) -> list[tuple[int, int, int, int]]:
    """Returns the runs of each row, joined with equal runs of the next rows."""
    # The last row is empty, and ends all runs.
    padded = np.pad(cells.astype(np.int8), ((0, 1), (1, 1)))
    open_runs: dict[tuple[int, int], int] = {}
    found = []
    for row, steps in enumerate(np.diff(padded, axis=1)):
        runs = {*zip(np.flatnonzero(steps == 1).tolist(), np.flatnonzero(steps == -1).tolist(), strict=True)}
        for run in [run for run in open_runs if run not in runs]:
            first = open_runs.pop(run)
            found.append((first, run[0], row - first, run[1] - run[0]))
        for run in runs:
            open_runs.setdefault(run, row)
    return found


def _maximal(cells: np.ndarray) -> list[tuple[int, int, int, int]]:
    """Takes, at each uncovered cell in turn, the larger of the widest and the tallest rectangle of uncovered cells."""
    left = cells.copy()
    found = []
    for row, column in np.argwhere(cells).tolist():
        if left[row, column]:
            wide = _grow(left[row:, column:])
            tall = _grow(left[row:, column:].T)[::-1]
            height, width = max((wide, tall), key=lambda size: size[0] * size[1])
            left[row : row + height, column : column + width] = False
            found.append((row, column, height, width))
    return found


def _grow(cells: np.ndarray) -> tuple[int, int]:
    """Returns rows and columns of the rectangle from the first cell: as wide as its row, then as tall as possible."""
    width = int(np.append(cells[0], False).argmin())
    return int(np.append(cells[:, :width].all(1), False).argmin()), width
