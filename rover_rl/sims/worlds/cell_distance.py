"""Distances between the cells of a grid."""

from __future__ import annotations

import math

import numpy as np


def distance_to_cells(marked: np.ndarray, limit: float = math.inf) -> tuple[np.ndarray, np.ndarray]:
    """Returns the distance between the centers of cells and the nearest marked cell, and which cell that is.

    Args:
        marked: marked cells, bool ``[rows, columns]``.
        limit: largest distance of interest, in cells.

    Returns:
        Distances in cells, exact below the limit: float64 ``[rows, columns]``. Number of the nearest marked cell, row
        by row; of equally near ones, the one in the lowest column, and of these the one in the lowest row: int32
        ``[rows, columns]``, -1 if the limit is nearer.
    """
    # Importing NVIDIA Warp takes half a second.
    from rover_rl.sims.native.warp import wp
    from rover_rl.sims.worlds.distance_kernels import find_nearest_cells, find_nearest_rows

    most = math.ceil(min(limit, math.hypot(*marked.shape))) ** 2
    rows, squares, nearest = (np.empty(marked.shape, dtype=np.int32) for _ in range(3))
    wp.launch(find_nearest_rows, marked.shape[1], [np.ascontiguousarray(marked), rows], device="cpu")
    wp.launch(find_nearest_cells, len(marked), [rows, most, squares, nearest], device="cpu")
    return np.sqrt(squares), nearest
