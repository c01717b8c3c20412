"""Forest: a flat floor with tree trunks and clutter, which grows like the obstacles of the BARN worlds.

The clutter is a field of thin cylinders on a grid, made by a cellular automaton: random cells are filled, and then
smoothed. Cell size, radius and rule are those of the BARN dataset (Perille et al., Benchmarking Metric Ground
Navigation, SSRR 2020), whose 300 worlds have 15 to 30 % of random cells, 3 to 13 % of filled ones after smoothing.
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import distance_transform_edt

from rover_rl.worlds.generators.layouts import DEFAULT, cell_centers, in_square, is_connected, raised, scaled, square
from rover_rl.worlds.solids import cylinders
from rover_rl.worlds.terrain import Terrain
from rover_rl.worlds.world import World

SIDE, HALF_TASK = 10.0, 4.0
"""Side length of the floor, and half of that of the task area, m."""
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
    task = in_square(HALF_TASK, CELL, CELLS)
    while True:
        filled, trunks = _clutter(rng, difficulty), _trunks(rng, difficulty)
        clearance = _clearance(filled, trunks)
        is_open = is_connected(clearance >= gap / 2, task, CONNECTED, 0.0)
        if is_open and is_connected(clearance >= WIDE / 2, task, 0.0, SPACIOUS):
            break
    centers = cell_centers(CELL, CELLS)[np.argwhere(filled)[:, ::-1]]
    low = cylinders(raised(centers, HEIGHT / 2), RADIUS, HEIGHT, SIDES)
    tall = cylinders(raised(trunks[:, :2], TRUNK_HEIGHT / 2), trunks[:, 2], TRUNK_HEIGHT, TRUNK_SIDES)
    return World("forest", Terrain.flat((SIDE, SIDE)), (tall, low), spawn_range=square(HALF_TASK))


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
    clutter, axis = CELL * distance_transform_edt(~filled) - RADIUS, cell_centers(CELL, CELLS)
    x, y, radius = trunks.T[..., None, None]
    return np.minimum(clutter, (np.hypot(axis - x, axis[:, None] - y) - radius).min(0))
