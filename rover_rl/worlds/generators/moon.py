"""Moon: a plateau of gentle hills with craters and boulders."""

from __future__ import annotations

import math

import numpy as np
import torch

from rover_rl.worlds.generators.layouts import DEFAULT, relief, scaled, square
from rover_rl.worlds.solids import Solids, boulder
from rover_rl.worlds.terrain import Terrain
from rover_rl.worlds.world import World

SIZE, SIZES = 8.0, (4.0, 64.0)
"""Default, and smallest and largest side length of the task area, m."""
CELL = 0.25
AROUND, FAR, NEAR = 26.0, 16.0, 0.5
"""Margins of the terrain, of the area of all craters and boulders, and of that of the gentle ones, around the task
area, m."""
EAST = 6.0
"""Margin of the bounds in the east, m. In the other directions it is ``FAR``, as in the original environment."""
SLOPE_LENGTH = 7.0
"""Distance over which the ground descends to the edge of the terrain, m."""
EDGE_DROP = 3.0
"""Height of the plateau above the edge of the terrain, m."""
HILLS = (0.12, 0.22, 0.3)
"""Standard deviation of the height of the hills at difficulty 0, 0.5 and 1, m."""
FAR_CRATERS = (14, (1.5, 4.5), (0.12, 0.26))
NEAR_CRATERS = (3, (0.9, 1.5), (0.10, 0.16))
"""Craters: number at the default size, range of the radius (m), and range of the depth in radii.

Rovers can climb out of the craters of the task area.
"""
CRATER_DEPTH = (0.5, 1.0, 1.15)
"""Factor of the depth of all craters."""
NEAR_BOULDERS, FAR_BOULDERS = (4, 9, 16), 40
"""Maximum number of boulders at the default size."""
RADIUS = (0.5, 0.85)
"""Range of the radius of a boulder, m. Smaller ones would be below the scan plane of the lidar, at 0.32 m."""
GAP = (1.6, 1.2, 0.95)
"""Minimum gap between two boulders, m."""
MAX_ATTEMPTS = 400
"""Number of positions tried for the boulders of an area of the default size."""


def moon(seed: int = 0, difficulty: float = DEFAULT, size: float = SIZE) -> World:
    """Creates a moonlike plateau. Some of its craters and boulders are in the task area.

    With the difficulty, hills get higher, craters deeper, and boulders more (4, 9, 16 in the default task area) and
    closer together: the gaps between them are at least 1.6 m, 1.2 m (at 0.5) and 0.95 m wide. The task area has sides
    of ``size``, from 4 to 64 m. The terrain exceeds it by 26 m on every side.
    """
    if not SIZES[0] <= size <= SIZES[1]:
        raise ValueError(f"size must be from {SIZES[0]:g} to {SIZES[1]:g} m, got {size}")
    rng = np.random.default_rng(seed)
    half = size / 2
    terrain = _ground(rng, half, difficulty)
    bounds = ((-half - FAR, half + EAST), (-half - FAR, half + FAR))
    return World("moon", terrain, _boulders(rng, terrain, half, difficulty), square(half), bounds=bounds)


def _ground(rng: np.random.Generator, half: float, difficulty: float) -> Terrain:
    side = 2 * round((half + AROUND) / CELL) + 1
    edge = (side - 1) / 2 * CELL
    axis = np.linspace(-edge, edge, side)
    y, x = np.meshgrid(axis, axis, indexing="ij")
    hills = relief(rng, x.shape, CELL, (4.0, 30.0))
    bumps = relief(rng, x.shape, CELL, (0.8, 3.0), steepness=1.5)
    heights = scaled(difficulty, *HILLS) * hills + 0.01 * bumps
    for center, radius, depth in _craters(rng, half):
        depth *= scaled(difficulty, *CRATER_DEPTH)
        heights += depth * radius * _crater(np.hypot(x - center[0], y - center[1]) / radius)
    beyond = np.clip((np.hypot(x, y) - (edge - SLOPE_LENGTH)) / SLOPE_LENGTH, 0, 1)
    heights -= EDGE_DROP * beyond**2 * (3 - 2 * beyond)
    middle = side // 2
    return Terrain(heights - heights[middle, middle], CELL)


def _craters(rng: np.random.Generator, half: float) -> list[tuple[np.ndarray, float, float]]:
    """Samples the center, radius (m), and depth in radii of each crater. The steep craters avoid the task area."""
    craters: list[tuple[np.ndarray, float, float]] = []
    for margin, (count, radii, depths) in ((FAR, FAR_CRATERS), (NEAR, NEAR_CRATERS)):
        wanted = len(craters) + _count(count, half, margin)
        reach = half + margin
        while len(craters) < wanted:
            center, radius, depth = rng.uniform(-reach, reach, 2), rng.uniform(*radii), rng.uniform(*depths)
            if margin == NEAR or np.abs(center).max() > half + NEAR + 1.5 * radius:
                craters.append((center, radius, depth))
    return craters


def _count(count: float, half: float, margin: float) -> int:
    return round(count * ((half + margin) / (SIZE / 2 + margin)) ** 2)


def _crater(distance: np.ndarray) -> np.ndarray:
    bowl = 1.25 * np.minimum(distance, 1.0) ** 2 - 1.0
    rim = 0.25 * np.exp(-(((np.maximum(distance, 1.0) - 1.0) / 0.35) ** 2))
    return np.where(distance < 1, bowl, rim)


def _boulders(rng: np.random.Generator, terrain: Terrain, half: float, difficulty: float) -> list[Solids]:
    placed: list[tuple[float, float, float]] = []
    gap = scaled(difficulty, *GAP)
    for margin, count in ((NEAR, scaled(difficulty, *NEAR_BOULDERS)), (FAR, FAR_BOULDERS)):
        full = len(placed) + _count(count, half, margin)
        reach, attempts = half + margin, max(MAX_ATTEMPTS, _count(MAX_ATTEMPTS, half, margin))
        sampled = np.column_stack((rng.uniform(-reach, reach, (attempts, 2)), rng.uniform(*RADIUS, attempts)))
        for x, y, radius in sampled.tolist():
            apart = all(math.hypot(x - u, y - v) >= radius + other + gap for u, v, other in placed)
            if apart and len(placed) < full:
                placed.append((x, y, radius))
    ground = terrain.height_at(torch.tensor(placed, dtype=torch.float64)[:, :2])
    # The center is a quarter of the radius above the ground: partly buried, yet high enough for the lidar.
    return [boulder((x, y, z + r / 4), r, rng) for (x, y, r), z in zip(placed, ground.tolist(), strict=True)]
