"""The moon: an open island of gentle hills with craters and boulders."""

from __future__ import annotations

import math

import numpy as np
import torch

from rover_rl.sims.worlds.obstacles import Obstacle, boulder
from rover_rl.sims.worlds.relief import relief
from rover_rl.sims.worlds.terrain import Terrain
from rover_rl.sims.worlds.world import World

HALF_SIDE, CELL = 30.0, 0.25
TASK_AREA = ((-4.0, 4.0), (-4.0, 4.0))
SHORE = 23.0
"""Meters from the middle at which the island begins to fall away."""
FALL = 3.0
"""Meters from the island to the edge of the terrain."""
FAR, NEAR = (-20.0, 20.0), (-4.5, 4.5)
CRATERS = (((FAR, 14), (1.5, 4.5), (0.12, 0.26)), ((NEAR, 3), (0.9, 1.5), (0.10, 0.16)))
"""Craters: where and how many, radius (m), and depth in radii. Those of the task area can be climbed."""
BOULDERS = ((NEAR, 9), (FAR, 40))
"""Boulders: where, and how many at most."""
RADIUS = (0.5, 0.85)
"""Of a boulder, in meters. Smaller rocks would stay below the lidar, which looks 0.32 m above the ground."""
GAP = 1.2
"""Meters left free between two boulders."""
TRIES = 400
"""Places tried for the boulders of an area."""


def moon(seed: int = 0) -> World:
    """A moonlike island. A few of its craters and boulders lie among the goals.

    Args:
        seed: of hills, craters and boulders.
    """
    rng = np.random.default_rng(seed)
    terrain = _ground(rng)
    return World(
        name="moon",
        terrain=terrain,
        obstacles=_boulders(rng, terrain),
        spawn_range=TASK_AREA,
        goal_range=TASK_AREA,
        bounds=((-20.0, 10.0), (-20.0, 20.0)),
        spawn_height=0.75,
    )


def _ground(rng: np.random.Generator) -> Terrain:
    side = round(2 * HALF_SIDE / CELL) + 1
    axis = np.linspace(-HALF_SIDE, HALF_SIDE, side)
    y, x = np.meshgrid(axis, axis, indexing="ij")
    hills = relief(rng, x.shape, CELL, (4.0, 30.0))
    bumps = relief(rng, x.shape, CELL, (0.8, 3.0), steepness=1.5)
    heights = 0.22 * hills + 0.01 * bumps
    for center, radius, depth in _craters(rng):
        heights += depth * radius * _crater(np.hypot(x - center[0], y - center[1]) / radius)
    beyond = np.clip((np.hypot(x, y) - SHORE) / (HALF_SIDE - SHORE), 0, 1)
    heights -= FALL * beyond**2 * (3 - 2 * beyond)
    middle = side // 2
    return Terrain(heights - heights[middle, middle], CELL)


def _craters(rng: np.random.Generator) -> list[tuple[np.ndarray, float, float]]:
    """Center, radius (m), and depth in radii of each crater. The steep ones keep clear of the task area."""
    craters: list[tuple[np.ndarray, float, float]] = []
    for (area, count), radii, depths in CRATERS:
        wanted = len(craters) + count
        while len(craters) < wanted:
            center, radius, depth = rng.uniform(*area, 2), rng.uniform(*radii), rng.uniform(*depths)
            if area is NEAR or np.abs(center).max() > NEAR[1] + 1.5 * radius:
                craters.append((center, radius, depth))
    return craters


def _crater(distance: np.ndarray) -> np.ndarray:
    """Profile of a crater of radius 1 and depth 1: a bowl, a raised rim, and ejecta that thin out."""
    bowl = 1.25 * np.minimum(distance, 1.0) ** 2 - 1.0
    rim = 0.25 * np.exp(-(((np.maximum(distance, 1.0) - 1.0) / 0.35) ** 2))
    return np.where(distance < 1, bowl, rim)


def _boulders(rng: np.random.Generator, terrain: Terrain) -> list[Obstacle]:
    """Boulders at random places that keep their distance, as many of them as find one."""
    placed: list[tuple[float, float, float]] = []
    for area, count in BOULDERS:
        full = len(placed) + count
        for x, y, radius in np.column_stack((rng.uniform(*area, (TRIES, 2)), rng.uniform(*RADIUS, TRIES))):
            apart = all(math.hypot(x - u, y - v) >= radius + other + GAP for u, v, other in placed)
            if apart and len(placed) < full:
                placed.append((float(x), float(y), float(radius)))
    ground = terrain.height_at(torch.tensor(placed, dtype=torch.float64)[:, :2])
    # The middle a quarter of the radius over the ground: sunk, yet high enough for the lidar.
    return [boulder((x, y, z + r / 4), r, rng) for (x, y, r), z in zip(placed, ground.tolist(), strict=True)]
