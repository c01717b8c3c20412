"""Warp kernels that measure the distances to obstacles on maps of seen obstacles."""

from __future__ import annotations

from rover_rl.envs.seen_map.scan_kernels import HALF, LAST, OCCUPIED, PARTS, SIZE, address, away
from rover_rl.native.warp import wp

REACH = wp.constant(5)  # number of cells around a cell in which the nearest obstacle is looked for
WHOLE_CELL = wp.constant(wp.vec4ub(PARTS - 1, PARTS - 1, PARTS - 1, PARTS - 1))  # box of an obstacle that fills it


@wp.kernel
def find_closed(
    centers: wp.array[wp.vec2i],
    bounds: wp.array[wp.vec4],
    lidars: wp.array[wp.vec4],
    views: wp.array2d[wp.bool],
    offset: float,
    passes: wp.array2d[wp.uint8],
    closed: wp.array2d[wp.bool],
):
    """Cells that count as obstacles without evidence; a thread does a cell of a row.

    Those are cells that no beam has passed or come near, where the lidar does not see now, and those out of bounds.

    Lengths are in cells. ``lidars`` are x and y, headings (rad), and distances within which nothing is unknown, and
    ``views`` tell whether each reading sees. ``offset`` is half of a beam, in readings, and ``passes`` are 1 in cells
    that beams have passed. Results are where the cells are stored.
    """
    n, cell = wp.tid()
    column = (cell & LAST) + centers[n][0] - HALF
    row = cell / SIZE + centers[n][1] - HALF
    x = float(column) + 0.5
    y = float(row) + 0.5
    lidar = lidars[n]
    way = wp.vec2(x - lidar[0], y - lidar[1])
    count = views.shape[1]
    # From 0 to two turns.
    angle = wp.mod(wp.atan2(way[1], way[0]) - lidar[2], 2.0 * wp.pi) + 2.0 * wp.pi
    reading = int(angle / (2.0 * wp.pi) * float(count) + offset) % count
    unknown = wp.length(way) > lidar[3] and not views[n, reading]
    if unknown:
        # Beams pass between the middles of cells.
        for k in range(9):
            unknown = unknown and passes[n, address(column + k % 3 - 1, row + k / 3 - 1)] == wp.uint8(0)
    area = bounds[n]
    closed[n, address(column, row)] = unknown or x < area[0] or y < area[1] or x > area[2] or y > area[3]


@wp.kernel
def find_distances(
    centers: wp.array[wp.vec2i],
    evidence: wp.array2d[wp.uint8],
    boxes: wp.array2d[wp.vec4ub],
    closed: wp.array2d[wp.bool],
    distances: wp.array2d[float],
):
    """Distances of the middles of cells to the nearest box of an obstacle; a thread does a cell of a row.

    ``evidence`` and ``boxes`` are the map (see ``scan_kernels.Cells``), and ``closed`` cells that count as obstacles as
    well. Results are row by row from the lower corner of the window, in cells, at most ``REACH``.
    """
    n, cell = wp.tid()
    center = centers[n]
    column = cell & LAST
    row = cell / SIZE
    nearest = int(REACH * PARTS * REACH * PARTS)
    for dy in range(wp.max(-REACH, -row), wp.min(REACH, LAST - row) + 1):
        for dx in range(wp.max(-REACH, -column), wp.min(REACH, LAST - column) + 1):
            there = address(column + dx + center[0] - HALF, row + dy + center[1] - HALF)
            if closed[n, there] or int(evidence[n, there]) >= OCCUPIED:
                box = wp.where(closed[n, there], WHOLE_CELL, boxes[n, there])
                away_x = away(-dx, box[0], box[1])
                away_y = away(-dy, box[2], box[3])
                nearest = wp.min(nearest, away_x * away_x + away_y * away_y)
    distances[n, cell] = wp.sqrt(float(nearest)) / float(PARTS)
