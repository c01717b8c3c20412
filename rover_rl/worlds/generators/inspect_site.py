"""Inspection site: hilly ground and rows of solar panels. ``inspect`` is a module of Python's standard library."""

from __future__ import annotations

import math

import numpy as np
import torch

from rover_rl.worlds.generators.layouts import DEFAULT, relief, scaled, smoothstep
from rover_rl.worlds.solids import Solids, box, hull
from rover_rl.worlds.terrain import Terrain
from rover_rl.worlds.world import World

SIZE, CELL = (64.0, 100.0), 0.25
TASK_AREA = ((-27.0, -19.0), (-27.0, -19.0))
BOUNDS = ((-29.0, -13.0), (-29.0, -17.0))
CORNER = ((-math.inf, -24.5), (-math.inf, -24.5))
"""Highest part of the task area, where a live simulator uses a higher drop height."""

PANEL, TILT = (3.4, 2.0, 0.12), math.radians(28)
"""Dimensions of a panel (m) and its tilt toward the south (rad)."""
PANEL_ROWS = (-17.9, -14.3, -10.7, -7.1)
PANEL_COLUMNS = (-28.2, -23.4, -18.6, -13.8, -9.0)
WALLS = ((-25.8, -18.2), (-16.2, -18.4), (-21.0, -16.1), (-30.0, -16.2), (-11.5, -16.2), (-25.8, -12.5), (-16.2, -9.0))
WALL_SIZE = (1.8, 0.3)
HEIGHT_ABOVE, DEPTH_BELOW = 0.5, 0.3
"""Height of walls and panel fronts above the highest ground below them, so that the lidar sees them, and their depth
below the lowest ground, m."""

HUMPS = (0.12, 0.25, 0.27)
"""Maximum height of the humps at difficulty 0, 0.5 and 1, m."""
CRATES, CRATE_SIDE, CRATE_GAP = (0, 0, 10), (0.4, 1.0), 1.3
"""Maximum number of crates in the task area, range of their side lengths, and minimum gap between two of them, m."""
MAX_ATTEMPTS = 1000


def inspect(seed: int = 0, difficulty: float = DEFAULT) -> World:
    """Creates the inspection site: a knoll in the southwest, rough ground, panels and low walls in the north.

    The seed changes the ground. The difficulty makes it rougher: half as rough at 0 as at 0.5, and 8 % rougher at 1.
    Above 0.5, up to 10 crates stand in the task area.
    """
    rng = np.random.default_rng(seed)
    terrain = _ground(rng, scaled(difficulty, *HUMPS))
    panels = [part for y in PANEL_ROWS for x in PANEL_COLUMNS for part in _panel_on_stand(terrain, x, y)]
    walls = [_block(terrain, x, y, *WALL_SIZE) for x, y in WALLS]
    crates = [_block(terrain, *crate) for crate in _crates(rng, round(scaled(difficulty, *CRATES)))]
    solids, heights = (*panels, *walls, *crates), ((CORNER, 6.5),)
    return World("inspect", terrain, solids, TASK_AREA, bounds=BOUNDS, spawn_height=5.5, spawn_height_areas=heights)


def _ground(rng: np.random.Generator, height: float) -> Terrain:
    """Ground with humps of up to ``height``, m. With 0.25, its median slope is 9 degrees, as on the original site."""
    columns, rows = (round(side / CELL) + 1 for side in SIZE)
    y, x = np.meshgrid(np.linspace(-50, 50, rows), np.linspace(-32, 32, columns), indexing="ij")
    knoll = 1.63 * smoothstep((-20.36 - x) / 7.03) * (1 - 0.63 * smoothstep((y + 27) / 10))
    humps = relief(rng, x.shape, CELL, (1.0, 8.0))
    roughness = np.exp(0.65 * relief(rng, x.shape, CELL, (6.0, 20.0)))
    # tanh keeps the heights in range for all seeds and leaves most slopes unchanged.
    humps = height * np.tanh(0.5 * roughness * humps)
    away = np.hypot(np.maximum(np.abs(x + 21) - 9, 0), np.maximum(np.abs(y + 23) - 7, 0))
    hills = 1.2 * relief(rng, x.shape, CELL, (12.0, 60.0)) * smoothstep(away / 25)
    return Terrain(4.445 + knoll + humps + hills, CELL)


def _crates(rng: np.random.Generator, count: int) -> list[tuple[float, float, float, float]]:
    """Samples the center and side lengths along x and y of crates that keep the minimum gap, m."""
    crates: list[tuple[float, float, float, float]] = []
    for _ in range(MAX_ATTEMPTS if count else 0):
        (x, y), (length, depth) = rng.uniform(*np.array(TASK_AREA).T).tolist(), rng.uniform(*CRATE_SIDE, 2).tolist()
        gaps = (max(abs(x - u) - (length + a) / 2, abs(y - v) - (depth + b) / 2) for u, v, a, b in crates)
        if min(gaps, default=math.inf) >= CRATE_GAP:
            crates.append((x, y, length, depth))
        if len(crates) == count:
            break
    return crates


def _panel_on_stand(terrain: Terrain, x: float, y: float) -> tuple[Solids, Solids]:
    length, depth = PANEL[0], PANEL[1] * math.cos(TILT)
    low, high = _ground_below(terrain, x, y, length, depth)
    front, back = high + HEIGHT_ABOVE, high + HEIGHT_ABOVE + PANEL[1] * math.sin(TILT)
    across, along = np.array((-length / 2, length / 2)) + x, np.array((-depth / 2, depth / 2)) + y
    bottom = [(u, v, low - DEPTH_BELOW) for u in across for v in along]
    top = [(u, v, z) for u in across for v, z in zip(along, (front, back), strict=True)]
    lift = PANEL[2] / 2
    center = (x, y - lift * math.sin(TILT), (front + back) / 2 + lift * math.cos(TILT))
    return hull(np.array(bottom + top)), box(center, PANEL, roll=TILT)


def _block(terrain: Terrain, x: float, y: float, length: float, depth: float) -> Solids:
    low, high = _ground_below(terrain, x, y, length, depth)
    bottom, top = low - DEPTH_BELOW, high + HEIGHT_ABOVE
    return box((x, y, (bottom + top) / 2), (length, depth, top - bottom))


def _ground_below(terrain: Terrain, x: float, y: float, length: float, depth: float) -> tuple[float, float]:
    """Minimum and maximum height (m) of the ground below a rectangle around ``(x, y)``."""
    ends = ((x - length / 2, x + length / 2), (y - depth / 2, y + depth / 2))
    axes = (torch.linspace(low, high, 21, dtype=torch.float64) for low, high in ends)
    heights = terrain.height_at(torch.cartesian_prod(*axes))
    return float(heights.min()), float(heights.max())
