"""Ramps: a test ground with platforms, mounds, ditches, steps and blocks on a grid of lots, and roads between them."""

from __future__ import annotations

import numpy as np
import torch
from scipy.ndimage import binary_erosion

from rover_rl.worlds.generators.layouts import DEFAULT, gentle_cells, in_square, is_connected, scaled, square
from rover_rl.worlds.solids import boxes
from rover_rl.worlds.terrain import Terrain
from rover_rl.worlds.world import World

CELL = 0.2
"""Spacing of the terrain, m. All edges lie on its lines.

Lengths in this module are in cells unless they name a unit.
"""
LOTS, LOT, ROAD = 3, 20, 7
"""Number of lots along a side, side length of a lot, and width of the roads between and around the lots."""
PITCH = LOT + ROAD
CELLS = LOTS * PITCH + ROAD
IMPASSABLE = (0.15, 0.45, 0.75)
"""Probability that the structure of a lot is not passable, at difficulty 0, 0.5 and 1."""
BARRIERS = (0, 4, 8)
"""Number of road sections that a barrier closes."""
BARRIER_HEIGHT = 0.6
PLATFORM, MOUND, STEEP_MOUND, DITCH, LOW_STEP, HIGH_STEP = 0.4, 0.35, 0.7, 0.35, 0.06, 0.2
"""Heights and depths, m. The lidar, at 0.32 m, sees platforms from below."""
CONNECTED, SPACIOUS = 0.8, 0.35
"""Minimum fraction of the passable ground of the task area, and of all of it, that is connected for the rover."""
ERODED = np.ones((5, 5), dtype=bool)
"""Cells around a cell that must be passable, too: half a rover in each direction."""
MARGIN = 3
"""Distance between the task area and the edge of the ground."""


def ramps(seed: int = 0, difficulty: float = DEFAULT) -> World:
    """Creates a test ground of 17.6 x 17.6 m with nine structures between roads.

    Structures are platforms with ramps on some sides, mounds, ditches with a ford or a bridge, and steps. Each is
    passable or not: the flanks of passable ones are at most 20 degrees steep, those of the others at least 33. With the
    difficulty, more of them are not passable, and barriers close up to 8 of the 24 road sections between two crossings.
    At least 80 % of the passable ground of the task area is connected. The lidar does not see ditches, and edges only
    from below.
    """
    rng, task = np.random.default_rng(seed), (CELLS / 2 - MARGIN) * CELL
    inside = in_square(task, CELL, CELLS)
    while True:
        heights = _ground(rng, scaled(difficulty, *IMPASSABLE))
        barriers = _barriers(rng, round(scaled(difficulty, *BARRIERS)))
        if is_connected(_passable(heights, barriers), inside, CONNECTED, SPACIOUS):
            break
    half, tall = CELLS * CELL / 2, np.full(len(barriers), BARRIER_HEIGHT)
    x, y, width, depth = CELL * barriers.T
    centers = np.stack((x + width / 2 - half, y + depth / 2 - half, tall / 2), -1)
    terrain = Terrain(torch.from_numpy(heights), CELL)
    return World("ramps", terrain, boxes(centers, np.stack((width, depth, tall), -1)), square(task))


def _ground(rng: np.random.Generator, impassable: float) -> np.ndarray:
    heights = np.zeros((CELLS + 1, CELLS + 1))
    for row in range(LOTS):
        for column in range(LOTS):
            low, left = ROAD + row * PITCH, ROAD + column * PITCH
            lot = heights[low : low + LOT + 1, left : left + LOT + 1]
            # The structure is built along x, in a view that may be turned.
            lot = lot.T if rng.random() < 0.5 else lot
            build = (_platform, _mound, _ditch, _steps)[rng.integers(4)]
            build(rng, lot, bool(rng.random() >= impassable))
    return heights


def _platform(rng: np.random.Generator, lot: np.ndarray, passable: bool) -> None:
    middle, run = slice(6, LOT - 5), 6 if passable else 3
    lot[middle, middle] = PLATFORM
    rise = np.linspace(0, PLATFORM, run + 1)
    sides = [lot, lot[:, ::-1], lot.T, lot.T[:, ::-1]]
    for side in sides[: int(rng.integers(2, 5))]:
        side[middle, 6 - run : 7] = rise


def _mound(rng: np.random.Generator, lot: np.ndarray, passable: bool) -> None:
    axis = np.arange(LOT + 1) - LOT / 2
    away = np.hypot(*np.meshgrid(axis, axis)) / (LOT / 2)
    if passable:
        lot[:] = MOUND * (0.5 + 0.5 * np.cos(np.pi * away.clip(0, 1)))
    else:
        lot[:] = STEEP_MOUND * ((1 - away) / rng.uniform(0.3, 0.5)).clip(0, 1)


def _ditch(rng: np.random.Generator, lot: np.ndarray, passable: bool) -> None:
    ford = passable and rng.random() < 0.5
    side, floor = (5, 3) if ford else (1, int(rng.integers(3, 6)))
    across = np.abs(np.arange(LOT + 1) - LOT / 2) - floor / 2
    lot[:] = -DITCH * (1 - across / side).clip(0, 1)
    lot[[0, -1]] = 0.0
    if passable and not ford:
        bridge = int(rng.integers(1, LOT - 8))
        lot[bridge : bridge + 9] = 0.0


def _steps(rng: np.random.Generator, lot: np.ndarray, passable: bool) -> None:
    count, height = (3, LOW_STEP) if passable else (2, HIGH_STEP)
    first = int(rng.integers(0, 3))
    for edge in range(first, first + 3 * count, 3):
        lot[edge + 1 : LOT - edge, edge + 1 : LOT - edge] += height


def _barriers(rng: np.random.Generator, count: int) -> np.ndarray:
    """Samples barriers across roads, in the middle of a lot's side: left, bottom, width and depth, ``[N, 4]``."""
    road, lot = PITCH * np.arange(LOTS + 1), ROAD + PITCH * np.arange(LOTS) + LOT // 2
    across, along = (grid.ravel() for grid in np.meshgrid(road, lot))
    thin, wide = np.ones_like(along), np.full_like(along, ROAD)
    sections = np.concatenate((np.stack((across, along, wide, thin), -1), np.stack((along, across, thin, wide), -1)))
    return sections[rng.permutation(len(sections))[:count]]


def _passable(heights: np.ndarray, barriers: np.ndarray) -> np.ndarray:
    """Returns the cells in which the center of a rover may be: bool ``[CELLS, CELLS]``."""
    cells = gentle_cells(heights, CELL)
    for left, bottom, width, depth in barriers.tolist():
        cells[bottom : bottom + depth, left : left + width] = False
    return binary_erosion(cells, ERODED)
