"""Warp kernels for distances between the cells of a grid.

The nearest marked cell of each cell, in two passes over columns and rows (P. F. Felzenszwalb and D. P. Huttenlocher,
"Distance transforms of sampled functions", Theory of Computing 8, 2012).
"""

from __future__ import annotations

from rover_rl.sims.native.warp import wp


@wp.kernel
def find_nearest_rows(marked: wp.array2d[wp.bool], rows: wp.array2d[int]):
    """Finds the nearest marked cell within each column; thread ``i`` does column i.

    Args:
        marked: marked cells, ``[rows, columns]``.
        rows: results: row of the marked cell, the lower of two equally near ones, or -1 if the column has none.
    """
    i = wp.tid()
    count = marked.shape[0]
    last = int(-1)
    for j in range(count):
        if marked[j, i]:
            last = j
        rows[j, i] = last
    last = int(-1)
    for back in range(count):
        j = count - 1 - back
        if marked[j, i]:
            last = j
        below = rows[j, i]
        if last >= 0 and (below < 0 or last - j < j - below):
            rows[j, i] = last


@wp.kernel
def find_nearest_cells(rows: wp.array2d[int], limit: int, squares: wp.array2d[int], nearest: wp.array2d[int]):
    """Finds the nearest marked cell of each cell; thread ``j`` does row j.

    Args:
        rows: row of the nearest marked cell in each column, from :func:`find_nearest_rows`.
        limit: largest squared distance of interest, in cells.
        squares: results: squared distances between the centers, in cells, at most ``limit``.
        nearest: results: number of the nearest marked cell, row by row; of equally near ones, that in the lowest
            column. -1 if none is nearer than ``limit``.
    """
    j = wp.tid()
    columns = rows.shape[1]
    for i in range(columns):
        best = int(limit)
        found = int(-1)
        away = int(0)
        while away * away <= best and away < columns:
            for side in range(2):
                column = wp.where(side == 0, i - away, i + away)
                if column >= 0 and column < columns:
                    row = rows[j, column]
                    square = away * away + (row - j) * (row - j)
                    if row >= 0 and (square < best or (square == best and found >= 0 and column < found % columns)):
                        best = square
                        found = row * columns + column
            away += 1
        squares[j, i] = best
        nearest[j, i] = found
