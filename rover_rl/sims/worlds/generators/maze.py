"""Maze: a flat floor of 20 x 20 m, enclosed by walls, with blocks on a 1 m grid."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import label

from rover_rl.sims.worlds.obstacles import Obstacle, box
from rover_rl.sims.worlds.terrain import Terrain
from rover_rl.sims.worlds.world import World

SIDE = 20
"""Side length of the floor, in meters and in squares of the grid."""
TASK_AREA = ((-4.0, 4.0), (-4.0, 4.0))
BLOCKS = 36
LENGTHS = (1, 2, 3, 4, 5)
LARGEST = (2, 9)
WALL_THICKNESS = 0.2
WALL_HEIGHT, BLOCK_HEIGHT = 2.0, 1.0
MIDDLE = slice(SIDE // 2 - 4, SIDE // 2 + 4)
"""Rows and columns of the task area."""
MIDDLE_SHARE = (0.25, 0.4)
"""Minimum and maximum fraction of the task area's squares that blocks cover."""
MAX_ATTEMPTS = 3000
"""Maximum number of positions tried for the blocks of a layout."""
NEIGHBORS = ((np.s_[1:, :], np.s_[:-1, :]), (np.s_[:, 1:], np.s_[:, :-1]))
"""Pairs of views of the grid in which adjacent squares have the same index."""


def maze(seed: int = 0) -> World:
    """Creates a maze of 36 blocks between four walls. Corridors are at least 1 m wide, and all of them are connected.

    Args:
        seed: seed of the layout.
    """
    blocks = _layout(np.random.default_rng(seed))
    return World(
        name="maze",
        terrain=Terrain.flat((SIDE, SIDE)),
        obstacles=(*_walls(), *(_block(*block) for block in blocks)),
        spawn_range=TASK_AREA,
        goal_range=TASK_AREA,
        bounds=((-30.0, 30.0), (-30.0, 30.0)),
        spawn_height=0.75,
    )


def _layout(rng: np.random.Generator) -> list[tuple[int, int, int, int]]:
    """Samples blocks ``(row, column, rows, columns)``, in squares of the grid."""
    while True:
        blocks = _place_blocks(rng)
        taken = np.zeros((SIDE, SIDE), dtype=bool)
        for block in blocks:
            taken[_squares(block)] = True
        if len(blocks) == BLOCKS and MIDDLE_SHARE[0] <= taken[MIDDLE, MIDDLE].mean() <= MIDDLE_SHARE[1]:
            return blocks


def _place_blocks(rng: np.random.Generator) -> list[tuple[int, int, int, int]]:
    """Places blocks one by one until all are placed or the attempts are used up."""
    # Long blocks first, because they do not fit later.
    sizes = [LARGEST, *((1, int(length)) for length in sorted(rng.choice(LENGTHS, BLOCKS - 1), reverse=True))]
    taken = np.zeros((SIDE, SIDE), dtype=bool)
    blocks: list[tuple[int, int, int, int]] = []
    for _ in range(MAX_ATTEMPTS):
        if len(blocks) == BLOCKS:
            break
        rows, columns = sizes[len(blocks)] if rng.random() < 0.5 else sizes[len(blocks)][::-1]
        block = (int(rng.integers(SIDE - rows + 1)), int(rng.integers(SIDE - columns + 1)), rows, columns)
        new = np.zeros_like(taken)
        new[_squares(block)] = True
        # The largest block would cover too much of the task area, so it is placed outside.
        largest_in_task_area = not blocks and new[MIDDLE, MIDDLE].any()
        if not largest_in_task_area and _fits(taken, new) and _drivable(taken | new):
            taken |= new
            blocks.append(block)
    return blocks


def _squares(block: tuple[int, int, int, int]) -> tuple[slice, slice]:
    row, column, rows, columns = block
    return slice(row, row + rows), slice(column, column + columns)


def _fits(taken: np.ndarray, new: np.ndarray) -> bool:
    """Returns whether a block overlaps nothing and touches other blocks and walls along at most one square's side."""
    if (taken & new).any():
        return False
    solid, block = np.pad(taken, 1, constant_values=True), np.pad(new, 1)
    return sum((solid[a] & block[b]).sum() + (solid[b] & block[a]).sum() for a, b in NEIGHBORS) <= 1


def _drivable(taken: np.ndarray) -> bool:
    """Returns whether the free squares are connected by their sides and no two blocks touch only at a corner."""
    a, b, c, d = taken[:-1, :-1], taken[:-1, 1:], taken[1:, :-1], taken[1:, 1:]
    corner_gap = (a & d & ~b & ~c) | (b & c & ~a & ~d)
    return not corner_gap.any() and label(~taken)[1] == 1


def _block(row: int, column: int, rows: int, columns: int) -> Obstacle:
    x, y = column + columns / 2 - SIDE / 2, row + rows / 2 - SIDE / 2
    return box((x, y, BLOCK_HEIGHT / 2), (columns, rows, BLOCK_HEIGHT))


def _walls() -> tuple[Obstacle, ...]:
    """Creates four walls just outside the floor, so that the outer corridors keep their full width."""
    middle, length = (SIDE + WALL_THICKNESS) / 2, SIDE + 2 * WALL_THICKNESS
    along_x = (length, WALL_THICKNESS, WALL_HEIGHT)
    along_y = (WALL_THICKNESS, length, WALL_HEIGHT)
    return tuple(
        box((x, y, WALL_HEIGHT / 2), size)
        for x, y, size in (
            (0, -middle, along_x),
            (0, middle, along_x),
            (-middle, 0, along_y),
            (middle, 0, along_y),
        )
    )
