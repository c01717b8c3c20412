"""Distances between the cells of a grid."""

from __future__ import annotations

import math

import numpy as np
from scipy.ndimage import distance_transform_edt


def distance_to_cells(marked: np.ndarray, limit: float = math.inf) -> tuple[np.ndarray, np.ndarray]:
    """Returns the distance between the centers of cells and the nearest marked cell, and which cell that is.

    Args:
        marked: marked cells, bool ``[rows, columns]``.
        limit: largest distance, in cells. Without a marked cell, all cells have it.

    Returns:
        Distances in cells, float64 ``[rows, columns]``. Number of the nearest marked cell, row by row, int32
        ``[rows, columns]``; -1 without a marked cell.
    """
    if not marked.any():
        return np.full(marked.shape, limit), np.full(marked.shape, -1, dtype=np.int32)
    distance, (rows, columns) = distance_transform_edt(~marked, return_indices=True)
    return np.minimum(distance, limit), rows * marked.shape[1] + columns
