"""Connected open ground of layouts, on a grid."""

from __future__ import annotations

import math

import numpy as np
from scipy.ndimage import label

from rover_rl.sims.worlds.terrain import MAX_SLOPE


def largest_part(open_cells: np.ndarray, inside: np.ndarray) -> tuple[float, float]:
    """Returns how much of an area the largest connected part of the open cells covers.

    Args:
        open_cells: cells that a rover may enter, bool ``[rows, columns]``. Cells are connected by their sides.
        inside: cells of the area, bool ``[rows, columns]``.

    Returns:
        The part's cells in the area, as fractions of the open cells in the area and of all cells in the area.
    """
    counts = np.bincount(label(open_cells)[0][inside])
    largest = counts[1:].max(initial=0)
    return float(largest / max(counts[1:].sum(), 1)), float(largest / counts.sum())


def gentle_cells(heights: np.ndarray, cell: float) -> np.ndarray:
    """Returns which cells of a terrain are passable, by the slopes of their two triangles.

    Args:
        heights: heights ``[rows, columns]``, m.
        cell: spacing of the grid, m.

    Returns:
        Whether no triangle of a cell is steeper than :data:`~rover_rl.sims.worlds.terrain.MAX_SLOPE`, bool
        ``[rows - 1, columns - 1]``.
    """
    along_x, along_y = np.diff(heights, axis=1), np.diff(heights, axis=0)
    lower, upper = np.hypot(along_x[:-1], along_y[:, :-1]), np.hypot(along_x[1:], along_y[:, 1:])
    return np.maximum(lower, upper) <= math.tan(MAX_SLOPE) * cell
