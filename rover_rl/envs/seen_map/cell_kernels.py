"""Warp functions on the cells of maps of seen obstacles.

A map is a window of ``SIZE x SIZE`` cells around the rover, which moves with it cell by cell. Cell (X, Y) of the world
covers ``CELL * [X, X + 1)`` by ``CELL * [Y, Y + 1)``, m. It is stored at ``(Y mod SIZE) * SIZE + X mod SIZE``, so that
nothing moves in memory when the window does: only the cells that enter are cleared. The surroundings of a cell at one
edge of the window therefore reach over to the opposite edge.

Cells are as wide as a gap's tolerance. Occupied ones therefore also hold the box in which the obstacle has been seen.
Each cell has a level by the distance of its middle from the nearest box, the number of suspected cells around it, and
on rough ground the greatest height, in m, at which the ground has been seen there.
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
MOST = wp.constant(12)
"""Largest evidence from readings. Each beam that passes through a cell takes 1 away."""
CLOSED = wp.constant(255)
"""Evidence of a cell that is too steep, or that the rover could not get to. Beams do not change it."""
MAX_TILT = wp.constant(0.42)
"""Slope above which ground is too steep, rad: 24 degrees. Tires of usual friction (0.5) slide at 26.6."""
PARTS = wp.constant(16)
"""Number of parts along a side of a cell, in which the ends of beams are told apart."""
OPEN = wp.constant(4)
"""Level of a cell far from obstacles. Cells at obstacles have level 0, and :class:`Clearance` tells the others."""
UNSEEN = wp.constant(-1.0e9)
"""Height of a cell whose ground has not been seen, m."""
DOUBTFUL = wp.constant(2)
"""Highest level of a cell near a suspected one. A route crosses it if a detour is three times as long, or longer."""


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
    heights: wp.array[float],
):
    """Clears the columns and rows that enter the window in the place of those that leave it."""
    for axis in range(2):
        shift = after[axis] - before[axis]
        for k in range(wp.min(wp.abs(shift), SIZE)):
            entered = wp.where(shift > 0, after[axis] + HALF - 1 - k, after[axis] - HALF + k)
            for other in range(SIZE):
                x = wp.where(axis == 0, entered, other)
                y = wp.where(axis == 0, other, entered)
                if rough:
                    heights[address(x, y)] = UNSEEN
                if evidence[address(x, y)] > wp.uint8(0):
                    weaken(x, y, 0, rough, clearance, evidence, boxes, levels, doubts)


@wp.func
def clear_window(
    rough: bool,
    evidence: wp.array[wp.uint8],
    levels: wp.array[wp.uint8],
    doubts: wp.array[wp.int16],
    heights: wp.array[float],
):
    """Clears all cells. On ground that is not rough, heights are of no use."""
    for cell in range(SIZE * SIZE):
        if rough:
            heights[cell] = UNSEEN
        evidence[cell] = wp.uint8(0)
        levels[cell] = wp.uint8(OPEN)
        doubts[cell] = wp.int16(0)
