"""Maze: a flat floor of 20 x 20 m, enclosed by walls, with blocks on a 1 m grid."""

from __future__ import annotations

from functools import reduce
from operator import or_
from typing import NamedTuple

import numpy as np

from rover_rl.worlds.generators.layouts import DEFAULT, enclosing_walls, scaled, square
from rover_rl.worlds.solids import Solids, boxes
from rover_rl.worlds.terrain import Terrain
from rover_rl.worlds.world import World

SIDE = 20
"""Side length of the floor, in meters and in squares of the grid."""
HALF_TASK = 4
BLOCKS, FEWEST_BLOCKS = 36, 10
"""Number of blocks at difficulty 0.5, and 0."""
LENGTHS = (1, 2, 3, 4, 5)
LARGEST = (2, 9)
BLOCK_HEIGHT = 1.0
MIDDLE_SHARE = (0.25, 0.4)
"""Minimum and maximum fraction of the task area's squares that blocks cover."""
MAX_ATTEMPTS = 3000
WIDENING = 0.5
"""Width by which corridors exceed 1 m at difficulty 0, m."""


class Block(NamedTuple):
    """Rectangle of squares of the grid."""

    row: int
    column: int
    rows: int
    columns: int


def maze(seed: int = 0, difficulty: float = DEFAULT) -> World:
    """Creates a maze of blocks between four walls, whose corridors are all connected.

    Layouts of the same seed are variants of one another. At difficulty 0.5 there are 36 blocks, and corridors are at
    least 1 m wide, the narrowest in which the rover drives and turns with a margin. Toward 0, blocks are removed until
    10 are left, and corridors widen to 1.5 m (1.25 m where blocks touch). Toward 1, passages between blocks are closed,
    which turns loops into dead ends and detours; at 1, as many as possible, so that hardly any loop is left.
    """
    count, rng = round(scaled(difficulty, FEWEST_BLOCKS, BLOCKS, BLOCKS)), np.random.default_rng(seed)
    blocks = _layout(rng)
    if difficulty < DEFAULT:
        blocks = _thinned(blocks, rng, count)
    elif difficulty > DEFAULT:
        closed = _closable_squares(blocks, rng)
        blocks += closed[: round(scaled(difficulty, 0, 0, len(closed)))]
    obstacles = enclosing_walls(SIDE), _solid(blocks, difficulty)
    return World("maze", Terrain.flat((SIDE, SIDE)), obstacles, square(float(HALF_TASK)), bounds=square(30.0))


def _layout(rng: np.random.Generator) -> list[Block]:
    while True:
        blocks = _place_blocks(rng)
        share = (_union(blocks) & _MIDDLE).bit_count() / _MIDDLE.bit_count()
        if len(blocks) == BLOCKS and MIDDLE_SHARE[0] <= share <= MIDDLE_SHARE[1]:
            return blocks


def _place_blocks(rng: np.random.Generator) -> list[Block]:
    # Long blocks first, because they do not fit later.
    sizes = [LARGEST, *((1, int(length)) for length in sorted(rng.choice(LENGTHS, BLOCKS - 1), reverse=True))]
    taken = 0
    blocks: list[Block] = []
    for _ in range(MAX_ATTEMPTS):
        if len(blocks) == BLOCKS:
            break
        rows, columns = sizes[len(blocks)] if rng.random() < 0.5 else sizes[len(blocks)][::-1]
        block = Block(int(rng.integers(SIDE - rows + 1)), int(rng.integers(SIDE - columns + 1)), rows, columns)
        new = _squares(block)
        # The largest block would cover too much of the task area, so it is placed outside.
        largest_in_task_area = not blocks and new & _MIDDLE
        if not largest_in_task_area and _fits(taken, new):
            taken |= new
            blocks.append(block)
    return blocks


def _fits(taken: int, new: int) -> bool:
    """Returns whether a block may be added to the taken squares.

    It must overlap nothing, and touch other blocks and walls along at most one square's side, and none only at a
    corner. So the free squares remain connected by their sides: those around the block are a ring with one gap at most.
    """
    if taken & new:
        return False
    sides = sum((neighbors & new).bit_count() for neighbors in _shifted(taken | _WALLS))
    return sides <= 1 and not _corner_gaps(taken | new)


def _thinned(blocks: list[Block], rng: np.random.Generator, count: int) -> list[Block]:
    order = [blocks[k] for k in rng.permutation(len(blocks))]
    while len(order) > count:
        rest = ([other for other in order if other is not block] for block in order)
        order = next((blocks for blocks in rest if not _corner_gaps(_union(blocks))), order[1:])
    return order


def _closable_squares(blocks: list[Block], rng: np.random.Generator) -> list[Block]:
    taken = _union(blocks)
    west, east, south, north = _shifted(taken | _WALLS)
    corridors = _FLOOR & ~taken & ((west & east & ~south & ~north) | (south & north & ~west & ~east))
    closed: list[Block] = []
    for index in rng.permutation([bit for bit in range(corridors.bit_length()) if corridors >> bit & 1]).tolist():
        square = 1 << index
        beside = _FLOOR & ~taken & sum(_shifted(square))
        if beside.bit_count() == 2 and _connected(beside & -beside, beside & (beside - 1), _FLOOR & ~(taken | square)):
            taken |= square
            closed.append(Block(index // _WIDTH - 1, index % _WIDTH - 1, 1, 1))
    return closed


# Sets of squares as integers, which are much faster than arrays. Square (row, column) is bit
# (row + 1) * _WIDTH + column + 1, so that there is a margin of one square for the walls.

_WIDTH = SIDE + 2


def _squares(block: Block) -> int:
    line = ((1 << block.columns) - 1) << (block.column + 1)
    return (line * _COLUMN[block.rows]) << (block.row + 1) * _WIDTH


def _union(blocks: list[Block]) -> int:
    return reduce(or_, map(_squares, blocks), 0)


def _shifted(squares: int) -> tuple[int, int, int, int]:
    return squares << 1, squares >> 1, squares << _WIDTH, squares >> _WIDTH


def _corner_gaps(taken: int) -> int:
    east, north, northeast = taken >> 1, taken >> _WIDTH, taken >> (_WIDTH + 1)
    return _NOT_LAST & ((taken & northeast & ~east & ~north) | (east & north & ~taken & ~northeast))


def _connected(one: int, other: int, free: int) -> bool:
    """Returns whether free squares connect two of them. Both grow until they meet, or one fills all that it reaches."""
    while not one & other:
        more, others = (free & (reduce(or_, _shifted(grown), grown)) for grown in (one, other))
        if more == one or others == other:
            return False
        one, other = more, others
    return True


_COLUMN = [sum(1 << row * _WIDTH for row in range(rows)) for rows in range(SIDE + 1)]
"""Squares of a column of each length."""
_FLOOR = _squares(Block(0, 0, SIDE, SIDE))
_NOT_LAST = _squares(Block(0, 0, SIDE - 1, SIDE - 1))
_WALLS = ((1 << _WIDTH * _WIDTH) - 1) & ~_FLOOR
_MIDDLE = _squares(Block(SIDE // 2 - HALF_TASK, SIDE // 2 - HALF_TASK, 2 * HALF_TASK, 2 * HALF_TASK))


def _solid(blocks: list[Block], difficulty: float) -> Solids:
    row, column, rows, columns = np.array(blocks, dtype=float).T
    low, high = np.stack((column, row)) - SIDE / 2, np.stack((column + columns, row + rows)) - SIDE / 2
    if difficulty < DEFAULT:
        trim = scaled(difficulty, WIDENING / 2, 0.0, 0.0)
        south_west, north_east = _free_sides(blocks)
        low, high = low + trim * south_west, high - trim * north_east
    tall = np.full(len(blocks), BLOCK_HEIGHT)
    return boxes(np.vstack(((low + high) / 2, tall / 2)).T, np.vstack((high - low, tall)).T)


def _free_sides(blocks: list[Block]) -> tuple[np.ndarray, np.ndarray]:
    """Which sides touch no block and no wall: west and south, and east and north of each block, ``[2, N]``."""
    solid = _union(blocks) | _WALLS
    pairs = ((squares, _shifted(solid & ~squares)) for squares in map(_squares, blocks))
    free = [[not neighbors & squares for neighbors in sides] for squares, sides in pairs]
    west, east, south, north = np.array(free).T
    return np.stack((west, south)), np.stack((east, north))
