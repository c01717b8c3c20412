"""Warp kernels that measure the distances to obstacles on maps of seen obstacles."""

from __future__ import annotations

from rover_rl.envs.seen_map.scan_kernels import HALF, LAST, OCCUPIED, PARTS, SIZE, address, away
from rover_rl.native.warp import wp

REACH = wp.constant(5)  # number of cells around a cell in which the nearest obstacle is looked for
WHOLE_CELL = wp.constant(wp.vec4ub(PARTS - 1, PARTS - 1, PARTS - 1, PARTS - 1))  # box of an obstacle that fills it
# What is in a cell: nothing, an obstacle in its box, one that fills it, or one that fills those around it, too.
FREE, BOX, WHOLE, INNER = map(wp.constant, range(4))
GROUP = wp.constant(8)  # number of cells that are read at once
INNER_GROUP = wp.constant(wp.int64(int(INNER) * 0x0101010101010101))


@wp.kernel
def find_obstacles(
    rows: wp.array[wp.bool],
    centers: wp.array[wp.vec2i],
    evidence: wp.array2d[wp.uint8],
    bounds: wp.array[wp.vec4],
    lidars: wp.array[wp.vec4],
    views: wp.array2d[wp.bool],
    wholes: wp.array[wp.bool],
    offset: float,
    passes: wp.array2d[wp.uint8],
    found: wp.array2d[wp.uint8],
    first: int,
):
    """What is in the cells of the chosen rows; a thread does a cell of a row.

    Without evidence, cells count as obstacles that no beam has passed or come near, where the lidar does not see now,
    and those out of bounds.

    Lengths are in cells. ``lidars`` are x and y, headings (rad), and distances within which nothing is unknown,
    ``views`` tell whether each reading sees, and ``wholes`` whether all of them do. ``offset`` is half of a beam, in
    readings, and ``passes`` are 1 in cells that beams have passed. Results are where the cells are stored.
    """
    t, cell = wp.tid()
    n = first + t
    if not rows[n]:
        return
    column = (cell & LAST) + centers[n][0] - HALF
    row = cell / SIZE + centers[n][1] - HALF
    x = float(column) + 0.5
    y = float(row) + 0.5
    lidar = lidars[n]
    unknown = bool(False)
    if not wholes[n]:
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
    here = address(column, row)
    content = wp.where(int(evidence[n, here]) >= OCCUPIED, BOX, FREE)
    out = wp.max(wp.max(area[0] - x, area[1] - y), wp.max(x - area[2], y - area[3]))
    if unknown or out > 0.0:
        content = wp.where(out > 1.0, INNER, WHOLE)
    found[n, here] = wp.uint8(content)


@wp.kernel
def find_distances(
    rows: wp.array[wp.bool],
    centers: wp.array[wp.vec2i],
    boxes: wp.array2d[wp.vec4ub],
    found: wp.array2d[wp.uint8],
    groups: wp.array2d[wp.int64],
    distances: wp.array2d[float],
    begin: int,
):
    """Distances of the middles of cells to the nearest box of an obstacle; a thread does a line of cells of a row.

    ``boxes`` are those of the map (see ``scan_kernels.Cells``), ``found`` is what is in the cells, and ``groups`` are
    the same in groups. Results are row by row from the lower corner of the window, in cells, at most ``REACH``.
    """
    t, line = wp.tid()
    n = begin + t
    if not rows[n]:
        return
    center = centers[n]
    for k in range(line * SIZE, (line + 1) * SIZE):
        distances[n, k] = float(REACH * PARTS * REACH * PARTS)  # squares of distances, in parts
    for dy in range(wp.max(-REACH, -line), wp.min(REACH, LAST - line) + 1):
        first = address(0, line + dy + center[1] - HALF)
        for group in range(SIZE / GROUP):
            contents = groups[n, first / GROUP + group]
            if contents != wp.int64(0) and (dy == 0 or contents != INNER_GROUP):
                for here in range(first + group * GROUP, first + (group + 1) * GROUP):
                    content = int(found[n, here])
                    if content != FREE and (dy == 0 or content != INNER):
                        column = (here - center[0] + HALF) & LAST
                        box = wp.where(content == BOX, boxes[n, here], WHOLE_CELL)
                        reach = wp.where(content == INNER, 0, REACH)
                        away_y = away(-dy, box[2], box[3])
                        for dx in range(wp.max(-reach, -column), wp.min(reach, LAST - column) + 1):
                            away_x = away(dx, box[0], box[1])
                            k = line * SIZE + column + dx
                            distances[n, k] = wp.min(distances[n, k], float(away_x * away_x + away_y * away_y))
    for k in range(line * SIZE, (line + 1) * SIZE):
        distances[n, k] = wp.sqrt(distances[n, k]) / float(PARTS)
