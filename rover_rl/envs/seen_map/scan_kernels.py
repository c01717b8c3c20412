"""Warp kernel that adds lidar scans to maps of seen obstacles.

Cell (X, Y) of the world is stored at ``(Y mod SIZE) * SIZE + X mod SIZE``, so that nothing moves in memory when the
window does: only the cells that enter are cleared. The surroundings of a cell at one edge of the window therefore reach
over to the opposite edge.
"""

from __future__ import annotations

from rover_rl.envs.seen_map import scans
from rover_rl.native.warp import wp

SIZE, HALF, LAST = wp.constant(scans.SIZE), wp.constant(scans.HALF), wp.constant(scans.SIZE - 1)
CELL, PARTS, UNSEEN = wp.constant(scans.CELL), wp.constant(scans.PARTS), wp.constant(scans.UNSEEN)
SUSPECTED, OCCUPIED, HIT = wp.constant(scans.SUSPECTED), wp.constant(scans.OCCUPIED), wp.constant(scans.HIT)
MOST, CLOSED = wp.constant(scans.MOST), wp.constant(scans.CLOSED)
OPEN, DOUBTFUL = wp.constant(scans.OPEN), wp.constant(scans.DOUBTFUL)
REACH, NO_GAP, STRETCH = wp.constant(scans.REACH), wp.constant(scans.NO_GAP), wp.constant(scans.STRETCH)
MAX_TILT = wp.constant(scans.MAX_TILT)
CROSSED = wp.constant(8)  # added to the level of a cell on the way of what moves, while routes are planned


@wp.func
def address(x: int, y: int):
    return (y & LAST) * SIZE + (x & LAST)


@wp.func
def address_at(x: float, y: float):
    return address(int(wp.floor(x)), int(wp.floor(y)))


@wp.struct
class Cells:
    """The map of a row. ``limits`` and ``reach`` are those of :func:`~rover_rl.envs.seen_map.scans.limits_of`."""

    rough: bool
    limits: wp.vec4i
    reach: int
    evidence: wp.array[wp.uint8]  # of an obstacle in each cell
    # Where in each occupied cell the obstacle has been seen since the cell was free: PARTS - 1 - first and last part
    # along x, and along y. Larger numbers are larger boxes.
    boxes: wp.array[wp.vec4ub]
    heights: wp.array[float]  # of the ground in each cell, m
    levels: wp.array[wp.uint8]  # of each cell by the distance of its middle from the nearest box
    doubts: wp.array[wp.int16]  # number of suspected cells around each one
    passed: wp.array[wp.uint8]  # 1 in cells that beams have passed


@wp.func
def away(offset: int, before: wp.uint8, last: wp.uint8):
    """Returns the distance along an axis of a cell's middle from a box, ``offset`` cells before the cell, in parts."""
    middle = PARTS * offset + PARTS / 2
    return wp.max(wp.max(PARTS - 1 - int(before) - middle, middle - int(last) - 1), 0)


@wp.func
def level_at(dx: int, dy: int, box: wp.vec4ub, limits: wp.vec4i):
    """Returns the level of cell (dx, dy) by its distance from a box in cell (0, 0)."""
    away_x = away(dx, box[0], box[1])
    away_y = away(dy, box[2], box[3])
    square = away_x * away_x + away_y * away_y
    level = int(OPEN)
    for k in range(3):
        level -= wp.where(square < limits[k], 1, 0)
    return level


@wp.func
def find_level(x: int, y: int, lowest: int, cells: Cells):
    """Returns the level of a cell that is not occupied, from all obstacles around it. It is at least ``lowest``."""
    level = int(OPEN)
    for dy in range(-cells.reach, cells.reach + 1):
        for dx in range(-cells.reach, cells.reach + 1):
            there = address(x + dx, y + dy)
            if level > lowest and int(cells.evidence[there]) >= OCCUPIED:
                level = wp.min(level, level_at(-dx, -dy, cells.boxes[there], cells.limits))
    return level


@wp.func
def set_evidence(x: int, y: int, value: int, cells: Cells):
    """Sets the evidence of a cell, and updates the levels around it that it has lowered and the number of doubts."""
    here = address(x, y)
    before = int(cells.evidence[here])
    cells.evidence[here] = wp.uint8(value)
    change = wp.where(value == SUSPECTED, 1, 0) - wp.where(before == SUSPECTED, 1, 0)
    freed = before >= OCCUPIED and value < OCCUPIED
    if freed or (cells.rough and change != 0):
        for dy in range(-cells.reach, cells.reach + 1):
            for dx in range(-cells.reach, cells.reach + 1):
                there = address(x + dx, y + dy)
                if cells.rough and PARTS * PARTS * (dx * dx + dy * dy) < cells.limits[3]:
                    cells.doubts[there] = wp.int16(int(cells.doubts[there]) + change)
                if freed:
                    lowered = level_at(dx, dy, cells.boxes[here], cells.limits)
                    if there == here or (lowered < OPEN and int(cells.levels[there]) == lowered):
                        cells.levels[there] = wp.uint8(find_level(x + dx, y + dy, lowered, cells))


@wp.func
def mark(x: float, y: float, value: int, cells: Cells):
    """Sets the evidence of an obstacle at a point to an occupied cell's, and lowers the levels around it."""
    column = int(wp.floor(x))
    row = int(wp.floor(y))
    here = address(column, row)
    part_x = wp.clamp(int((x - float(column)) * float(PARTS)), 0, PARTS - 1)
    part_y = wp.clamp(int((y - float(row)) * float(PARTS)), 0, PARTS - 1)
    box = wp.vec4ub(wp.uint8(PARTS - 1 - part_x), wp.uint8(part_x), wp.uint8(PARTS - 1 - part_y), wp.uint8(part_y))
    grows = bool(True)
    if int(cells.evidence[here]) >= OCCUPIED:
        box = wp.max(box, cells.boxes[here])
        if box == cells.boxes[here]:
            grows = False
    set_evidence(column, row, value, cells)
    if grows:
        cells.boxes[here] = box
        for dy in range(-cells.reach, cells.reach + 1):
            for dx in range(-cells.reach, cells.reach + 1):
                there = address(column + dx, row + dy)
                level = wp.min(int(cells.levels[there]), level_at(dx, dy, box, cells.limits))
                cells.levels[there] = wp.uint8(level)
        cells.levels[here] = wp.uint8(0)


@wp.func
def move_window(before: wp.vec2i, after: wp.vec2i, cells: Cells):
    """Clears the columns and rows that enter the window in the place of those that leave it."""
    for axis in range(2):
        shift = after[axis] - before[axis]
        for k in range(wp.min(wp.abs(shift), SIZE)):
            entered = wp.where(shift > 0, after[axis] + HALF - 1 - k, after[axis] - HALF + k)
            for other in range(SIZE):
                x = wp.where(axis == 0, entered, other)
                y = wp.where(axis == 0, other, entered)
                cells.heights[address(x, y)] = UNSEEN
                cells.passed[address(x, y)] = wp.uint8(0)
                if cells.evidence[address(x, y)] > wp.uint8(0):
                    set_evidence(x, y, 0, cells)


@wp.func
def clear_window(cells: Cells):
    for cell in range(SIZE * SIZE):
        cells.evidence[cell] = wp.uint8(0)
        cells.heights[cell] = UNSEEN
        cells.levels[cell] = wp.uint8(OPEN)
        cells.doubts[cell] = wp.int16(0)
        cells.passed[cell] = wp.uint8(0)


@wp.func
def close_steep(x: float, y: float, cells: Cells):
    """Closes the cell halfway between that of a point and others nearby, if the ground between them is too steep.

    Heights of two cells that are n cells apart may be those of points n + 1 cells apart.
    """
    column = int(wp.floor(x))
    row = int(wp.floor(y))
    here = cells.heights[address(column, row)]
    for dy in range(-STRETCH, STRETCH + 1):
        for dx in range(-STRETCH, STRETCH + 1):
            there = cells.heights[address(column + dx, row + dy)]
            square = dx * dx + dy * dy
            limit = wp.tan(MAX_TILT) * CELL * (wp.sqrt(float(square)) + 1.0)
            if there > UNSEEN and square <= STRETCH * STRETCH and wp.abs(there - here) > limit:
                upward = wp.where(there > here, 1, 0)
                to_x = column + wp.sign(dx) * ((wp.abs(dx) + upward) / 2)
                to_y = row + wp.sign(dy) * ((wp.abs(dy) + upward) / 2)
                if int(cells.evidence[address(to_x, to_y)]) != CLOSED:
                    mark(float(to_x) + 0.5, float(to_y) + 0.5, CLOSED, cells)


@wp.kernel
def add_scans(
    added: wp.array[wp.bool],
    befores: wp.array[wp.vec2i],
    centers: wp.array[wp.vec2i],
    cleared: wp.array[wp.bool],
    roughs: wp.array[wp.bool],
    origins: wp.array[wp.vec2],
    beams: wp.array2d[wp.vec3],
    hits: wp.array2d[wp.bool],
    suspects: wp.array2d[wp.bool],
    grounds: wp.array2d[wp.vec3],
    closed: wp.array2d[wp.vec2],
    closes: wp.array2d[wp.bool],
    limits: wp.array[wp.vec4i],
    reaches: wp.array[int],
    evidences: wp.array2d[wp.uint8],
    boxes: wp.array2d[wp.vec4ub],
    heights: wp.array2d[float],
    levels: wp.array2d[wp.uint8],
    doubts: wp.array2d[wp.int16],
    passes: wp.array2d[wp.uint8],
    first: int,
):
    """Adds a scan to each row's map; thread ``t`` does row ``first + t``.

    Each beam takes 1 from the evidence of the cells that it passes, up to 1.5 cells before its end. Then each one that
    ends at an obstacle adds ``HIT`` to the cell at its end. Then the cells between two neighboring ones of these ends
    count as occupied, too, if nothing fits between them. Other ends on rough ground are suspected. Each stage follows
    the other for all beams, so that their order does not matter.

    Three kinds of cells are closed for good: those that are too steep by the heights around them, one uphill of a rover
    on a steep slope, and one on the route of a rover that makes no way, whether it cannot or does not dare to. On rough
    ground, the height of a cell is the greatest one that has been seen there, at the end of a beam or below the rover.

    The rows ``added`` change. ``befores`` are the cells in the middle of the windows before. ``centers`` and what
    follows are those of a :class:`~rover_rl.envs.seen_map.scans.Scan`, ``limits`` and ``reaches`` those of each row's
    robot, and what follows is that of :class:`Cells`, ``[N, SIZE * SIZE]``.
    """
    i = first + wp.tid()
    if not added[i]:
        return
    cells = Cells()
    cells.rough = roughs[i]
    cells.limits = limits[i]
    cells.reach = reaches[i]
    cells.evidence = evidences[i]
    cells.boxes = boxes[i]
    cells.heights = heights[i]
    cells.levels = levels[i]
    cells.doubts = doubts[i]
    cells.passed = passes[i]
    if cleared[i]:
        clear_window(cells)
    else:
        move_window(befores[i], centers[i], cells)
    x = origins[i][0]
    y = origins[i][1]
    count = beams.shape[1]
    for k in range(count):
        beam = beams[i, k]
        # Cells that the beam crosses along the axis along which it crosses more.
        crossed = wp.max(wp.abs(beam[0]), wp.abs(beam[1]))
        for n in range(int(wp.min(crossed - 1.5, float(REACH)))):
            part = float(n + 1) / crossed
            along = int(wp.floor(x + part * beam[0]))
            across = int(wp.floor(y + part * beam[1]))
            before = int(cells.evidence[address(along, across)])
            if before > 0 and before <= MOST:
                set_evidence(along, across, before - 1, cells)
            cells.passed[address(along, across)] = wp.uint8(1)
    for k in range(count):
        beam = beams[i, k]
        before = int(cells.evidence[address_at(x + beam[0], y + beam[1])])
        if hits[i, k] and before <= MOST:
            mark(x + beam[0], y + beam[1], wp.min(before + HIT, MOST), cells)
    for k in range(count):
        beam = beams[i, k]
        # The last reading is a neighbor of the first one.
        other = (k + 1) % count
        gap = beams[i, other] - beam
        if hits[i, k] and hits[i, other] and wp.length(wp.vec2(gap[0], gap[1])) < NO_GAP:
            steps = wp.ceil(wp.max(wp.abs(gap[0]), wp.abs(gap[1])))
            for n in range(1, int(steps)):
                between_x = x + beam[0] + float(n) / steps * gap[0]
                between_y = y + beam[1] + float(n) / steps * gap[1]
                before = int(cells.evidence[address_at(between_x, between_y)])
                mark(between_x, between_y, wp.max(before, OCCUPIED), cells)
    for k in range(count):
        column = int(wp.floor(x + beams[i, k][0]))
        row = int(wp.floor(y + beams[i, k][1]))
        if suspects[i, k] and int(cells.evidence[address(column, row)]) < SUSPECTED:
            set_evidence(column, row, SUSPECTED, cells)
    for k in range(count + 1):
        point = grounds[i, k]
        if point[2] > UNSEEN:
            cell = address_at(point[0], point[1])
            cells.heights[cell] = wp.max(cells.heights[cell], point[2])
    for k in range(count + 1):
        point = grounds[i, k]
        if point[2] > UNSEEN:
            close_steep(point[0], point[1], cells)
    for k in range(2):
        if closes[i, k]:
            mark(closed[i, k][0], closed[i, k][1], CLOSED, cells)
