"""Moon: a plateau of gentle hills with craters and boulders."""

from __future__ import annotations

import math

import numpy as np
import torch

from rover_rl.sims.worlds.generators.relief import relief
from rover_rl.sims.worlds.obstacles import Obstacle, boulder
from rover_rl.sims.worlds.terrain import Terrain
from rover_rl.sims.worlds.world import World

HALF_SIDE, CELL = 30.0, 0.25
TASK_AREA = ((-4.0, 4.0), (-4.0, 4.0))
PLATEAU_RADIUS = 23.0
"""Radius of the plateau, beyond which the ground descends, m."""
EDGE_DROP = 3.0
"""Height of the plateau above the edge of the terrain, m."""
FAR, NEAR = (-20.0, 20.0), (-4.5, 4.5)
CRATERS = (((FAR, 14), (1.5, 4.5), (0.12, 0.26)), ((NEAR, 3), (0.9, 1.5), (0.10, 0.16)))
"""Craters: range of x and y (m) and number, range of the radius (m), and range of the depth in radii.

Rovers can climb out of the craters of the task area.
"""
BOULDERS = ((NEAR, 9), (FAR, 40))
"""Boulders: range of x and y (m), and maximum number."""
RADIUS = (0.5, 0.85)
"""Range of the radius of a boulder, m. Smaller ones would be below the scan plane of the lidar, at 0.32 m."""
GAP = 1.2
"""Minimum gap between two boulders, m."""
MAX_ATTEMPTS = 400
"""Number of positions tried for the boulders of an area."""


def moon(seed: int = 0) -> World:
    """Creates a moonlike plateau. Some of its craters and boulders are in the task area.

    Args:
        seed: seed of the hills, craters and boulders.
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
    beyond = np.clip((np.hypot(x, y) - PLATEAU_RADIUS) / (HALF_SIDE - PLATEAU_RADIUS), 0, 1)
    heights -= EDGE_DROP * beyond**2 * (3 - 2 * beyond)
    middle = side // 2
    return Terrain(heights - heights[middle, middle], CELL)


def _craters(rng: np.random.Generator) -> list[tuple[np.ndarray, float, float]]:
    """Samples the center, radius (m), and depth in radii of each crater. The steep craters avoid the task area."""
    craters: list[tuple[np.ndarray, float, float]] = []
    for (area, count), radii, depths in CRATERS:
        wanted = len(craters) + count
        while len(craters) < wanted:
            center, radius, depth = rng.uniform(*area, 2), rng.uniform(*radii), rng.uniform(*depths)
            if area is NEAR or np.abs(center).max() > NEAR[1] + 1.5 * radius:
                craters.append((center, radius, depth))
    return craters


def _crater(distance: np.ndarray) -> np.ndarray:
    """Returns the height profile of a crater of radius 1 and depth 1: a bowl, and a raised rim that decays outward."""
    bowl = 1.25 * np.minimum(distance, 1.0) ** 2 - 1.0
    rim = 0.25 * np.exp(-(((np.maximum(distance, 1.0) - 1.0) / 0.35) ** 2))
    return np.where(distance < 1, bowl, rim)


def _boulders(rng: np.random.Generator, terrain: Terrain) -> list[Obstacle]:
    """Places boulders at random positions that keep the minimum gap."""
    placed: list[tuple[float, float, float]] = []
    for area, count in BOULDERS:
        full = len(placed) + count
        for x, y, radius in np.column_stack(
            (rng.uniform(*area, (MAX_ATTEMPTS, 2)), rng.uniform(*RADIUS, MAX_ATTEMPTS))
        ):
            apart = all(math.hypot(x - u, y - v) >= radius + other + GAP for u, v, other in placed)
            if apart and len(placed) < full:
                placed.append((float(x), float(y), float(radius)))
    ground = terrain.height_at(torch.tensor(placed, dtype=torch.float64)[:, :2])
    # The center is a quarter of the radius above the ground: partly buried, yet high enough for the lidar.
    return [boulder((x, y, z + r / 4), r, rng) for (x, y, r), z in zip(placed, ground.tolist(), strict=True)]
