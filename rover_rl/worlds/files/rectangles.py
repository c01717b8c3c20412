"""Covers of cells by few rectangles, or by quadrilaterals that follow slanted walls."""

from __future__ import annotations

import numpy as np

MANY = 15_000
"""Number of rectangles above which no greedy cover is tried."""
SLACK = 0.5
"""Largest distance of a slanted side from the ends of the runs along it, cells: that of a line drawn in cells."""
ANCHORS = np.linspace(-SLACK, SLACK, 9)[:, None]
"""Offsets of a slanted side from the end of its first run that are tried, cells."""
LONGEST = 500
"""Largest number of rows of a slanted piece, so that chains of many pieces take little time."""


def cover(cells: np.ndarray) -> list[tuple[int, int, int, int]]:
    """Covers the true cells of a grid by few rectangles ``(row, column, rows, columns)`` that do not overlap.

    Takes the best of three covers: equal runs of consecutive rows, equal runs of consecutive columns, and, unless these
    are many, greedily the larger of the widest and the tallest rectangle at each cell.
    """
    along = _joined_runs(cells)
    across = [(row, column, rows, columns) for column, row, columns, rows in _joined_runs(cells.T)]
    best = min(along, across, key=len)
    return min(best, _maximal(cells), key=len) if len(best) <= MANY else best


def slanted_cover(cells: np.ndarray) -> np.ndarray:
    """Covers the true cells of a grid by few quadrilaterals, whose sides are within half a cell of the runs of cells.

    Returns:
        Corners ``[pieces, 4, 2]`` as (column, row) from the corner of the first cell.
    """
    along, across = _chains(cells), _chains(cells.T)
    if len(along) <= len(across):
        return np.stack([piece for chain in along for piece in _pieces(*chain)])
    return np.stack([piece[:, ::-1] for chain in across for piece in _pieces(*chain)])


def _chains(cells: np.ndarray) -> list[tuple[int, list[int], list[int]]]:
    padded = np.pad(cells.astype(np.int8), ((0, 0), (1, 1)))
    chains: list[tuple[int, list[int], list[int]]] = []
    above: list[tuple[int, list[int], list[int]]] = []
    for row, steps in enumerate(np.diff(padded, axis=1)):
        starts, ends = np.flatnonzero(steps == 1), np.flatnonzero(steps == -1)
        # The runs above that each run touches, from ``low`` up to ``high``, and how many runs each of those touches.
        low = np.searchsorted([chain[2][-1] for chain in above], starts)
        high = np.searchsorted([chain[1][-1] for chain in above], ends, "right")
        marks = np.zeros(len(above) + 1, int)
        np.add.at(marks, low, 1)
        np.add.at(marks, high, -1)
        touched = np.cumsum(marks)
        here = []
        for start, end, first, last in zip(starts.tolist(), ends.tolist(), low.tolist(), high.tolist(), strict=True):
            if last - first == 1 and touched[first] == 1:
                chain = above[first]
                chain[1].append(start)
                chain[2].append(end)
            else:
                chain = (row, [start], [end])
                chains.append(chain)
            here.append(chain)
        above = here
    return chains


def _pieces(row: int, starts: list[int], ends: list[int]) -> list[np.ndarray]:
    """Covers a chain of runs by quadrilaterals ``[4, 2]``, the first of them as long as possible, and so on."""
    left, right = np.array(starts, dtype=float), np.array(ends, dtype=float)
    first, found = 0, []
    while True:
        sides = [_sides(values[first:]) for values in (left, right)]
        count = min(int(lengths.max()) for lengths, _, _ in sides)
        (a, b), (c, d) = (_side(values[first], count, *side) for values, side in zip((left, right), sides, strict=True))
        # A piece that is one cell wide may become narrower, but not disappear.
        below, above = max(c - a, SLACK) / 2, max(d - b, SLACK) / 2
        low, high = row + first, row + first + count
        bottom, top = (a + c) / 2, (b + d) / 2
        found.append(np.array([(bottom - below, low), (bottom + below, low), (top + above, high), (top - above, high)]))
        if first + count == len(left):
            return found
        # Pieces share a run, so that no gap opens between them.
        first += max(1, count - 1)


def _side(
    value: float, count: int, lengths: np.ndarray, lowest: np.ndarray, highest: np.ndarray
) -> tuple[float, float]:
    if count == 1:
        return value, value
    best = int(np.where(lengths >= count, (highest - lowest)[:, count - 1], -1.0).argmax())
    slope = (lowest[best, count - 1] + highest[best, count - 1]) / 2
    begin = value + ANCHORS[best, 0] - slope / 2
    return begin, begin + slope * count


def _sides(values: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Finds lines near numbers of consecutive rows, from each anchor.

    Returns:
        Number of rows that a line can follow ``[A]``, and least and greatest slope up to each row ``[A, rows]``.
    """
    values = values[:LONGEST]
    steps = np.arange(1, len(values))
    rise = values[1:] - values[0] - ANCHORS
    lowest = np.maximum.accumulate((rise - SLACK) / steps, 1)
    highest = np.minimum.accumulate((rise + SLACK) / steps, 1)
    start = np.full((len(ANCHORS), 1), np.inf)
    lowest, highest = np.concatenate((-start, lowest), 1), np.concatenate((start, highest), 1)
    fits = np.concatenate((lowest <= highest, np.zeros((len(ANCHORS), 1), bool)), 1)
    return fits.argmin(1), lowest, highest


def _joined_runs(cells: np.ndarray) -> list[tuple[int, int, int, int]]:
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
    width = int(np.append(cells[0], False).argmin())
    return int(np.append(cells[:, :width].all(1), False).argmin()), width
