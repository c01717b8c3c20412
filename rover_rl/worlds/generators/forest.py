"""Forest: a flat floor with tree trunks and clutter, which grows like the obstacles of the BARN worlds.

The clutter is a field of thin cylinders on a grid, made by a cellular automaton: random cells are filled, and then
smoothed. Cell size, radius and rule are those of the BARN dataset (Perille et al., Benchmarking Metric Ground
Navigation, SSRR 2020), whose 300 worlds have 15 to 30 % of random cells, 3 to 13 % of filled ones after smoothing.
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import distance_transform_edt

from rover_rl.worlds.generators.layouts import DEFAULT, largest_part, scaled
from rover_rl.worlds.solids import cylinders
from rover_rl.worlds.terrain import Terrain
from rover_rl.worlds.world import World

SIDE = 10.0
"""Side length of the floor, m."""
TASK_AREA = ((-4.0, 4.0), (-4.0, 4.0))
CELL, CELLS = 0.15, 66
"""Side length of a cell of the clutter, m, and number of cells along a side of the floor."""
RADIUS, HEIGHT, SIDES = 0.075, 1.0, 8
"""Radius and height of the cylinders of the clutter, m, and number of their sides."""
FILL = (0.13, 0.16, 0.185)
"""Fraction of random cells that are filled, at difficulty 0, 0.5 and 1."""
SMOOTHINGS = 3
FULL, EMPTY = 4, 2
"""A cell with more than 4 filled neighbors of 8 is filled, and one with fewer than 2 is emptied."""
TRUNKS = (4, 8, 12)
"""Number of trunks at difficulty 0, 0.5 and 1."""
TRUNK_RADIUS, TRUNK_HEIGHT, TRUNK_SIDES = (0.12, 0.3), 2.0, 16
GAP = (1.2, 0.9, 0.7)
"""Width of the narrowest gap that leads from a part of the task area to another, at difficulty 0, 0.5 and 1, m."""
CONNECTED = 0.6
"""Minimum fraction of the task area's open ground that gaps of this width connect."""
WIDE, SPACIOUS = 0.9, 0.15
"""Width of wide passages, m, and minimum fraction of the whole task area that such passages connect."""


def forest(seed: int = 0, difficulty: float = DEFAULT) -> World:
    """Creates a forest: trunks between clumps of thin cylinders.

    With the difficulty, the clutter and the number of trunks grow, and the gaps that the rover has to pass shrink from
    1.2 m over 0.9 m (at 0.5) to 0.7 m: gaps of that width connect at least 60 % of the open ground of the task area.
    """
    gap, rng = scaled(difficulty, *GAP), np.random.default_rng(seed)
    while True:
        filled, trunks = _clutter(rng, difficulty), _trunks(rng, difficulty)
        if _connected(_clearance(filled, trunks), gap):
            break
    centers = _AXIS[np.argwhere(filled)[:, ::-1]]
    low = cylinders(_at_height(centers, HEIGHT / 2), RADIUS, HEIGHT, SIDES)
    tall = cylinders(_at_height(trunks[:, :2], TRUNK_HEIGHT / 2), trunks[:, 2], TRUNK_HEIGHT, TRUNK_SIDES)
    return World(name="forest", terrain=Terrain.flat((SIDE, SIDE)), obstacles=(tall, low), spawn_range=TASK_AREA)


def _clutter(rng: np.random.Generator, difficulty: float) -> np.ndarray:
    """Samples the filled cells: bool ``[rows, columns]``, rows along y."""
    padded = np.zeros((CELLS + 2, CELLS + 2), dtype=np.int8)
    inner = padded[1:-1, 1:-1]
    inner[:] = rng.random((CELLS, CELLS)) < scaled(difficulty, *FILL)
    for _ in range(SMOOTHINGS):
        lines = padded[:, :-2] + padded[:, 1:-1] + padded[:, 2:]
        neighbors = lines[:-2] + lines[1:-1] + lines[2:] - inner
        inner[:] = (neighbors > FULL) | ((neighbors >= EMPTY) & (inner > 0))
    return inner > 0


def _trunks(rng: np.random.Generator, difficulty: float) -> np.ndarray:
    """Samples the trunks: x, y and radius, ``[N, 3]``, m."""
    count = round(scaled(difficulty, *TRUNKS))
    reach = SIDE / 2 - 0.5
    return np.column_stack((rng.uniform(-reach, reach, (count, 2)), rng.uniform(*TRUNK_RADIUS, count)))


def _clearance(filled: np.ndarray, trunks: np.ndarray) -> np.ndarray:
    """Returns the distance of the center of each cell from the nearest solid: ``[rows, columns]``, m."""
    clutter = CELL * distance_transform_edt(~filled) - RADIUS
    across = np.hypot(_AXIS[None, None, :] - trunks[:, 0, None, None], _AXIS[None, :, None] - trunks[:, 1, None, None])
    return np.minimum(clutter, (across - trunks[:, 2, None, None]).min(0))


def _connected(clearance: np.ndarray, gap: float) -> bool:
    return (
        largest_part(clearance >= gap / 2, _TASK_CELLS)[0] >= CONNECTED
        and largest_part(clearance >= WIDE / 2, _TASK_CELLS)[1] >= SPACIOUS
    )


def _at_height(xy: np.ndarray, height: float) -> np.ndarray:
    return np.column_stack((xy, np.full(len(xy), height)))


_AXIS = CELL * (np.arange(CELLS) - (CELLS - 1) / 2)
"""Coordinates of the centers of the cells along an axis, m."""
_TASK_CELLS = np.logical_and.outer(*[np.abs(_AXIS) < TASK_AREA[0][1]] * 2)
