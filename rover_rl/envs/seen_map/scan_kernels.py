"""Warp kernels that add lidar scans to maps of seen obstacles.

A map is a window of ``SIZE x SIZE`` cells around the rover, which moves with it cell by cell. Cell (X, Y) of the world
covers ``CELL * [X, X + 1)`` by ``CELL * [Y, Y + 1)``, m. It is stored at ``(Y mod SIZE) * SIZE + X mod SIZE``, so that
nothing moves in memory when the window does: only the cells that enter are cleared. The surroundings of a cell at one
edge of the window therefore reach over to the opposite edge.

Cells are as wide as a gap's tolerance. Occupied ones therefore also hold the box in which the obstacle has been seen.
Each cell has a level by the distance of its middle from the nearest box, and the number of suspected cells around it.
"""

from __future__ import annotations

from rover_rl.sims.native.warp import wp

SIZE = wp.constant(128)
"""Number of cells along a side of the window. A power of two."""
HALF = wp.constant(64)
"""Number of cells on each side of the rover's."""
LAST = wp.constant(127)
"""Bits of a cell number that its address depends on."""
CELL = wp.constant(0.15)
"""Side length of a cell, m."""
SUSPECTED = wp.constant(1)
"""Evidence of a cell on rough ground in which a beam has ended: at an obstacle, or at a slope that can be climbed."""
OCCUPIED = wp.constant(2)
"""Evidence from which on a cell counts as occupied."""
HIT = wp.constant(4)
"""Evidence that a reading adds to the cell at its end."""
MOST = wp.constant(12)
"""Largest evidence from readings. Each beam that passes through a cell takes 1 away."""
CLOSED = wp.constant(255)
"""Evidence of a cell that is too steep, or that the rover could not get to. Beams do not change it."""
MAX_TILT = wp.constant(0.42)
"""Slope above which ground is too steep, rad: 24 degrees. Tires of usual friction (0.5) slide at 26.6."""
ROUGH_TILT = wp.constant(0.05)
"""Tilt of the rover above which the ground is not level, rad: 3 degrees. On level ground, starting and stopping tilt it
by 0.01 at most."""
AHEAD = wp.constant(3.0)
"""Distance from the rover at which a cell is closed, in cells: 0.45 m."""
WAY = wp.constant(0.5)
"""Distance up to which a rover is still around a place, m."""
PARTS = wp.constant(16)
"""Number of parts along a side of a cell, in which the ends of beams are told apart."""
OPEN = wp.constant(4)
"""Level of a cell far from obstacles. Cells at obstacles have level 0, and :class:`Clearance` tells the others."""
DOUBTFUL = wp.constant(2)
"""Highest level of a cell near a suspected one. A route crosses it if a detour is three times as long, or longer."""
NO_GAP = wp.constant(4.0)
"""Distance between the ends of neighboring beams up to which nothing fits between them, cells: 0.6 m."""
LOWEST = wp.constant(-4.0 / 3.0)
"""Height of the end of a beam, relative to the lidar, below which it is on the ground, cells: -0.2 m."""
REACH = wp.constant(60)
"""Number of cells along an axis up to which beams count: 9 m. All of them are in the window, if the lidar is at most
3 cells, 0.45 m, from the rover's center along each axis."""


@wp.func
def address(x: int, y: int):
    """Returns where cell (x, y) of the world is stored."""
    return (y & LAST) * SIZE + (x & LAST)


@wp.func
def cell_of(position: float):
    """Returns the number of the cell that holds a coordinate, m."""
    return int(wp.floor(position / CELL))


@wp.struct
class Clearance:
    """Squares of the distances from obstacles, in parts of a cell, below which the middles of cells have levels 1 to 3.

    Attributes:
        tight: below it, the rover does not fit.
        near: below it, it hardly fits.
        wide: below it, it should be slow.
        doubt: below it, the middles of a cell and of a suspected one are near each other.
        reach: number of cells within which an obstacle changes levels.
    """

    tight: int
    near: int
    wide: int
    doubt: int
    reach: int


@wp.func
def distance_square(dx: int, dy: int, box: int):
    """Returns the squared distance of the middle of cell (dx, dy) from a box in cell (0, 0), in parts.

    Args:
        dx: number of columns between the cells.
        dy: number of rows between them.
        box: first and last part of the box along x, and along y, with 4 bits each.
    """
    x = PARTS * dx + PARTS / 2
    y = PARTS * dy + PARTS / 2
    away_x = wp.max(wp.max((box & 15) - x, x - ((box >> 4) & 15) - 1), 0)
    away_y = wp.max(wp.max(((box >> 8) & 15) - y, y - ((box >> 12) & 15) - 1), 0)
    return away_x * away_x + away_y * away_y


@wp.func
def level_at(square: int, clearance: Clearance):
    """Returns the level of a cell by the squared distance of its middle from an obstacle, in parts."""
    level = int(OPEN)
    if square < clearance.tight:
        level = 1
    elif square < clearance.near:
        level = 2
    elif square < clearance.wide:
        level = 3
    return level


@wp.func
def level_of(cell: int, levels: wp.array[wp.uint8], doubts: wp.array[wp.int16]):
    """Returns the level of the cell at an address, with suspected cells around it."""
    level = int(levels[cell])
    return wp.where(doubts[cell] > wp.int16(0), wp.min(level, DOUBTFUL), level)


@wp.func
def find_level(x: int, y: int, lowest: int, clearance: Clearance, evidence: wp.array[wp.uint8], boxes: wp.array[int]):
    """Returns the level of a cell that is not occupied, from all obstacles around it. It is at least ``lowest``."""
    level = int(OPEN)
    for dy in range(-clearance.reach, clearance.reach + 1):
        for dx in range(-clearance.reach, clearance.reach + 1):
            there = address(x + dx, y + dy)
            if level > lowest and int(evidence[there]) >= OCCUPIED:
                level = wp.min(level, level_at(distance_square(-dx, -dy, boxes[there]), clearance))
    return level


@wp.func
def lower_levels(x: int, y: int, clearance: Clearance, boxes: wp.array[int], levels: wp.array[wp.uint8]):
    """Lowers the levels around a cell in which an obstacle has appeared or grown."""
    here = address(x, y)
    for dy in range(-clearance.reach, clearance.reach + 1):
        for dx in range(-clearance.reach, clearance.reach + 1):
            there = address(x + dx, y + dy)
            level = level_at(distance_square(dx, dy, boxes[here]), clearance)
            levels[there] = wp.uint8(wp.min(int(levels[there]), level))
    levels[here] = wp.uint8(0)


@wp.func
def count_doubt(x: int, y: int, change: int, clearance: Clearance, doubts: wp.array[wp.int16]):
    """Adds ``change`` to the number of suspected cells in the counts of the cells around one."""
    for dy in range(-clearance.reach, clearance.reach + 1):
        for dx in range(-clearance.reach, clearance.reach + 1):
            if PARTS * PARTS * (dx * dx + dy * dy) < clearance.doubt:
                there = address(x + dx, y + dy)
                doubts[there] = wp.int16(int(doubts[there]) + change)


@wp.func
def weaken(
    x: int,
    y: int,
    value: int,
    rough: bool,
    clearance: Clearance,
    evidence: wp.array[wp.uint8],
    boxes: wp.array[int],
    levels: wp.array[wp.uint8],
    doubts: wp.array[wp.int16],
):
    """Lowers the evidence of a cell. If that frees it, the levels that it has lowered are computed again."""
    here = address(x, y)
    before = int(evidence[here])
    evidence[here] = wp.uint8(value)
    if rough and before == SUSPECTED:
        count_doubt(x, y, -1, clearance, doubts)
    if rough and value == SUSPECTED:
        count_doubt(x, y, 1, clearance, doubts)
    if before >= OCCUPIED and value < OCCUPIED:
        for dy in range(-clearance.reach, clearance.reach + 1):
            for dx in range(-clearance.reach, clearance.reach + 1):
                there = address(x + dx, y + dy)
                lowered = level_at(distance_square(dx, dy, boxes[here]), clearance)
                if there == here or (lowered < OPEN and int(levels[there]) == lowered):
                    levels[there] = wp.uint8(find_level(x + dx, y + dy, lowered, clearance, evidence, boxes))


@wp.func
def mark(
    x: float,
    y: float,
    value: int,
    rough: bool,
    clearance: Clearance,
    evidence: wp.array[wp.uint8],
    boxes: wp.array[int],
    levels: wp.array[wp.uint8],
    doubts: wp.array[wp.int16],
):
    """Sets the evidence of an obstacle at a point, in cells, to an occupied cell's.

    The box of a cell holds the points at which obstacles have been seen since the cell was free.
    """
    column = int(wp.floor(x))
    row = int(wp.floor(y))
    part_x = wp.clamp(int((x - float(column)) * float(PARTS)), 0, PARTS - 1)
    part_y = wp.clamp(int((y - float(row)) * float(PARTS)), 0, PARTS - 1)
    here = address(column, row)
    first_x = part_x
    last_x = part_x
    first_y = part_y
    last_y = part_y
    before = int(evidence[here])
    if before >= OCCUPIED:
        first_x = wp.min(first_x, boxes[here] & 15)
        last_x = wp.max(last_x, (boxes[here] >> 4) & 15)
        first_y = wp.min(first_y, (boxes[here] >> 8) & 15)
        last_y = wp.max(last_y, (boxes[here] >> 12) & 15)
    box = first_x + (last_x << 4) + (first_y << 8) + (last_y << 12)
    evidence[here] = wp.uint8(value)
    if rough and before == SUSPECTED:
        count_doubt(column, row, -1, clearance, doubts)
    if before < OCCUPIED or box != boxes[here]:
        boxes[here] = box
        lower_levels(column, row, clearance, boxes, levels)


@wp.func
def suspect(
    x: float,
    y: float,
    clearance: Clearance,
    evidence: wp.array[wp.uint8],
    doubts: wp.array[wp.int16],
):
    """Suspects an obstacle at a point, in cells, if its cell has no evidence of one."""
    column = int(wp.floor(x))
    row = int(wp.floor(y))
    if int(evidence[address(column, row)]) < SUSPECTED:
        evidence[address(column, row)] = wp.uint8(SUSPECTED)
        count_doubt(column, row, 1, clearance, doubts)


@wp.func
def move_window(
    before: wp.vec2i,
    after: wp.vec2i,
    rough: bool,
    clearance: Clearance,
    evidence: wp.array[wp.uint8],
    boxes: wp.array[int],
    levels: wp.array[wp.uint8],
    doubts: wp.array[wp.int16],
):
    """Clears the columns and rows that enter the window in the place of those that leave it."""
    for axis in range(2):
        shift = after[axis] - before[axis]
        for k in range(wp.min(wp.abs(shift), SIZE)):
            entered = wp.where(shift > 0, after[axis] + HALF - 1 - k, after[axis] - HALF + k)
            for other in range(SIZE):
                x = wp.where(axis == 0, entered, other)
                y = wp.where(axis == 0, other, entered)
                if evidence[address(x, y)] > wp.uint8(0):
                    weaken(x, y, 0, rough, clearance, evidence, boxes, levels, doubts)


@wp.func
def clear_window(evidence: wp.array[wp.uint8], levels: wp.array[wp.uint8], doubts: wp.array[wp.int16]):
    """Clears all cells."""
    for cell in range(SIZE * SIZE):
        evidence[cell] = wp.uint8(0)
        levels[cell] = wp.uint8(OPEN)
        doubts[cell] = wp.int16(0)


@wp.func
def is_end(beam: wp.vec3, reading: float, max_range: float):
    """Returns whether a beam has hit something in the window.

    Args:
        beam: vector from the lidar to the end of the beam, in cells.
        reading: length of the beam, m.
        max_range: range at which a beam has hit nothing, m.
    """
    return reading < max_range and wp.max(wp.abs(beam[0]), wp.abs(beam[1])) < float(REACH)


@wp.func
def is_obstacle(beam: wp.vec3, up: wp.vec3, rough: bool):
    """Returns whether what a beam has hit is certainly an obstacle.

    On rough ground, the beam may end on a slope that the rover can climb. Some of the ground from below the lidar to
    the end of the beam is at least as steep as the straight line between them. So the end is an obstacle if that line
    is too steep: on a level rover with the lidar at 0.32 m, within 0.72 m. Farther ends are suspected ones.

    Args:
        beam: vector from the lidar to the end of the beam, in cells.
        up: vector from the ground below the lidar to the lidar, in cells.
        rough: whether the ground is rough.
    """
    rise = beam + up
    steep = rise[2] > wp.tan(MAX_TILT) * wp.length(wp.vec2(rise[0], rise[1]))
    return beam[2] > LOWEST and (steep or not rough)


@wp.kernel
def add_scans(
    poses: wp.array2d[float],
    readings: wp.array2d[float],
    directions: wp.array[wp.vec2],
    mount: wp.vec3,
    max_range: float,
    clearance: Clearance,
    patience: int,
    added: wp.array[wp.bool],
    renewed: wp.array[wp.bool],
    roughs: wp.array[wp.bool],
    places: wp.array2d[float],
    waits: wp.array[int],
    centers: wp.array[wp.vec2i],
    evidences: wp.array2d[wp.uint8],
    boxes: wp.array2d[int],
    levels: wp.array2d[wp.uint8],
    doubts: wp.array2d[wp.int16],
    first: int,
):
    """Adds a scan to each row's map; thread ``t`` does row ``first + t``.

    Each beam takes 1 from the evidence of the cells that it passes, up to 1.5 cells before its end. Then each one that
    ends at an obstacle adds ``HIT`` to the cell at its end. Then the cells between two neighboring ones of these ends
    count as occupied, too, if nothing fits between them. Other ends on rough ground are suspected.

    Two kinds of cells are closed for good: one uphill of a rover on a steep slope, and one ahead of a rover that has
    not got farther than ``WAY`` within ``patience`` scans, whether it cannot or does not dare to.

    The ground of a row is rough once its rover has tilted by ``ROUGH_TILT``. The row's map is cleared then, as what it
    holds may be gentle slopes.

    Args:
        poses: x, y (m), pitch, roll and yaw (rad) of the rovers, ``[N, 5]``.
        readings: lidar readings, ``[N, P]``, m.
        directions: cosine and sine of the angle of each reading in the frame of the lidar, ``[P]``.
        mount: position of the lidar in the frame of the rover, whose origin is on the ground, m.
        max_range: range at which a beam has hit nothing, m.
        clearance: distances from obstacles at which levels begin.
        patience: number of scans after which the cell ahead of a rover that makes no way is closed.
        added: rows whose scan is added. The others do not change.
        renewed: rows whose map is cleared first.
        roughs: whether the ground is rough, ``[N]``; updated.
        places: x and y of the places around which the rovers are, ``[N, 2]``, m; updated.
        waits: number of scans since they came there, or since a cell has been closed, ``[N]``; updated.
        centers: cells in the middle of the windows; updated.
        evidences: evidence of an obstacle in each cell, ``[N, SIZE * SIZE]``; updated.
        boxes: where in each occupied cell the obstacle is: see :func:`distance_square`. ``[N, SIZE * SIZE]``; updated.
        levels: level of each cell, ``[N, SIZE * SIZE]``; updated.
        doubts: number of suspected cells around each one, ``[N, SIZE * SIZE]``; updated.
        first: row of the first thread.
    """
    i = first + wp.tid()
    if not added[i]:
        return
    evidence = evidences[i]
    box = boxes[i]
    level = levels[i]
    doubt = doubts[i]
    center = wp.vec2i(cell_of(poses[i, 0]), cell_of(poses[i, 1]))
    cos_pitch = wp.cos(poses[i, 2])
    sin_pitch = wp.sin(poses[i, 2])
    cos_roll = wp.cos(poses[i, 3])
    sin_roll = wp.sin(poses[i, 3])
    was_rough = roughs[i] and not renewed[i]
    rough = was_rough or cos_pitch * cos_roll < wp.cos(ROUGH_TILT)
    roughs[i] = rough
    if renewed[i] or rough != was_rough:
        clear_window(evidence, level, doubt)
    else:
        move_window(centers[i], center, rough, clearance, evidence, box, level, doubt)
    centers[i] = center
    cos = wp.cos(poses[i, 4])
    sin = wp.sin(poses[i, 4])
    # Position of the lidar, in cells.
    x = (poses[i, 0] + mount[0] * cos - mount[1] * sin) / CELL
    y = (poses[i, 1] + mount[0] * sin + mount[1] * cos) / CELL
    # Axes of the rover in the world's frame: the columns of Rz(yaw) Ry(pitch) Rx(roll).
    ahead = wp.vec3(cos_pitch * cos, cos_pitch * sin, -sin_pitch)
    left = wp.vec3(
        sin_roll * sin_pitch * cos - cos_roll * sin, sin_roll * sin_pitch * sin + cos_roll * cos, sin_roll * cos_pitch
    )
    up = mount[2] / CELL * wp.cross(ahead, left)
    count = directions.shape[0]
    for k in range(count):
        beam = readings[i, k] / CELL * (directions[k][0] * ahead + directions[k][1] * left)
        # Cells that the beam crosses along the axis along which it crosses more.
        crossed = wp.max(wp.abs(beam[0]), wp.abs(beam[1]))
        for n in range(int(wp.min(crossed - 1.5, float(REACH)))):
            part = float(n + 1) / crossed
            along = int(wp.floor(x + part * beam[0]))
            across = int(wp.floor(y + part * beam[1]))
            passed = int(evidence[address(along, across)])
            if passed > 0 and passed <= MOST:
                weaken(along, across, passed - 1, rough, clearance, evidence, box, level, doubt)
    # After all beams have passed, so that no beam clears what another one has hit.
    for k in range(count):
        beam = readings[i, k] / CELL * (directions[k][0] * ahead + directions[k][1] * left)
        if is_end(beam, readings[i, k], max_range) and is_obstacle(beam, up, rough):
            before = int(evidence[address(int(wp.floor(x + beam[0])), int(wp.floor(y + beam[1])))])
            if before <= MOST:
                value = wp.min(before + HIT, MOST)
                mark(x + beam[0], y + beam[1], value, rough, clearance, evidence, box, level, doubt)
    for k in range(count):
        beam = readings[i, k] / CELL * (directions[k][0] * ahead + directions[k][1] * left)
        # The last reading is a neighbor of the first one.
        other = (k + 1) % count
        next_beam = readings[i, other] / CELL * (directions[other][0] * ahead + directions[other][1] * left)
        gap_x = next_beam[0] - beam[0]
        gap_y = next_beam[1] - beam[1]
        hit = is_end(beam, readings[i, k], max_range) and is_obstacle(beam, up, rough)
        next_hit = is_end(next_beam, readings[i, other], max_range) and is_obstacle(next_beam, up, rough)
        if hit and next_hit and wp.length(wp.vec2(gap_x, gap_y)) < NO_GAP:
            steps = wp.ceil(wp.max(wp.abs(gap_x), wp.abs(gap_y)))
            for n in range(1, int(steps)):
                between_x = x + beam[0] + float(n) / steps * gap_x
                between_y = y + beam[1] + float(n) / steps * gap_y
                before = int(evidence[address(int(wp.floor(between_x)), int(wp.floor(between_y)))])
                mark(between_x, between_y, wp.max(before, OCCUPIED), rough, clearance, evidence, box, level, doubt)
    # After all obstacles, so that the order of the beams does not matter.
    for k in range(count):
        beam = readings[i, k] / CELL * (directions[k][0] * ahead + directions[k][1] * left)
        if rough and is_end(beam, readings[i, k], max_range) and not is_obstacle(beam, up, rough):
            suspect(x + beam[0], y + beam[1], clearance, evidence, doubt)
    here_x = poses[i, 0] / CELL
    here_y = poses[i, 1] / CELL
    if cos_pitch * cos_roll < wp.cos(MAX_TILT):
        # The rover's vertical axis leans downhill.
        down_x = cos_roll * sin_pitch * cos + sin_roll * sin
        down_y = cos_roll * sin_pitch * sin - sin_roll * cos
        scale = AHEAD / wp.length(wp.vec2(down_x, down_y))
        mark(here_x - scale * down_x, here_y - scale * down_y, CLOSED, rough, clearance, evidence, box, level, doubt)
    waits[i] = waits[i] + 1
    if renewed[i] or wp.length(wp.vec2(poses[i, 0] - places[i, 0], poses[i, 1] - places[i, 1])) > WAY:
        places[i, 0] = poses[i, 0]
        places[i, 1] = poses[i, 1]
        waits[i] = 0
    if waits[i] >= patience:
        waits[i] = 0
        mark(here_x + AHEAD * cos, here_y + AHEAD * sin, CLOSED, rough, clearance, evidence, box, level, doubt)
