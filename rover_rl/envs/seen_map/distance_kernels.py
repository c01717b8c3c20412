"""Warp kernel that measures the distances to obstacles on maps of seen obstacles."""

from __future__ import annotations

from rover_rl.envs.seen_map.scan_kernels import HALF, LAST, OCCUPIED, PARTS, SIZE, address, away
from rover_rl.sims.native.warp import wp

REACH = wp.constant(5)
"""Number of cells around a cell in which the nearest obstacle is looked for."""


@wp.kernel
def find_distances(
    centers: wp.array[wp.vec2i],
    evidence: wp.array2d[wp.uint8],
    boxes: wp.array2d[wp.vec4ub],
    distances: wp.array2d[float],
):
    """Distances of the middles of cells to the nearest box of an obstacle; a thread does a cell of a row.

    Args:
        centers: cells in the middle of the windows.
        evidence, boxes: the map: see ``scan_kernels.Cells``.
        distances: results, row by row from the lower corner of the window, in cells, at most ``REACH``.
    """
    n, cell = wp.tid()
    center = centers[n]
    column = cell & LAST
    row = cell / SIZE
    nearest = int(REACH * PARTS * REACH * PARTS)
    for dy in range(wp.max(-REACH, -row), wp.min(REACH, LAST - row) + 1):
        for dx in range(wp.max(-REACH, -column), wp.min(REACH, LAST - column) + 1):
            there = address(column + dx + center[0] - HALF, row + dy + center[1] - HALF)
            if int(evidence[n, there]) >= OCCUPIED:
                box = boxes[n, there]
                away_x = away(-dx, box[0], box[1])
                away_y = away(-dy, box[2], box[3])
                nearest = wp.min(nearest, away_x * away_x + away_y * away_y)
    distances[n, cell] = wp.sqrt(float(nearest)) / float(PARTS)
