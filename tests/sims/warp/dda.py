"""The plain way to scan: each ray cell by cell through the grid (Amanatides and Woo, 1987), and at each obstacle."""

from __future__ import annotations

import math

import numpy as np

from rover_rl.sims.worlds import Obstacle, Terrain, World


def scan(world: World, origin: np.ndarray, rotation: np.ndarray, beams: int, reach: float) -> np.ndarray:
    """Ranges ``[beams]`` (m) from ``origin [3]``, ``inf`` where nothing is hit; the lidar is outside of everything."""
    angles = 2 * math.pi * np.arange(beams) / beams
    directions = np.stack((np.cos(angles), np.sin(angles), np.zeros(beams)), -1) @ rotation.T
    return np.array([_cast(world, origin, direction, reach) for direction in directions])


def _cast(world: World, origin: np.ndarray, direction: np.ndarray, reach: float) -> float:
    hits = [_through_obstacle(obstacle, origin, direction) for obstacle in world.obstacles]
    distance = min([*hits, _through_terrain(world.terrain, origin, direction, reach)])
    return distance if distance < reach else math.inf


def _through_obstacle(obstacle: Obstacle, origin: np.ndarray, direction: np.ndarray) -> float:
    """Where a ray enters a convex solid: after all planes that it crosses inwards, and before all others."""
    planes = obstacle.planes.numpy()
    height, slope = planes[:, :3] @ origin + planes[:, 3], planes[:, :3] @ direction
    if (height[slope == 0] > 0).any():
        return math.inf
    enter = (-height[slope < 0] / slope[slope < 0]).max(initial=-math.inf)
    leave = (-height[slope > 0] / slope[slope > 0]).min(initial=math.inf)
    return enter if 0 <= enter <= leave else math.inf


def _through_terrain(terrain: Terrain, origin: np.ndarray, direction: np.ndarray, reach: float) -> float:
    heights, cell = terrain.heights.double().numpy(), terrain.cell
    place, step = (origin[:2] - terrain.origin) / cell, direction[:2] / cell
    index = np.floor(place).astype(int)
    forward = np.where(step > 0, 1, -1)
    with np.errstate(divide="ignore", invalid="ignore"):
        to_border = np.where(step != 0, (index + (step > 0) - place) / step, math.inf)
        between = np.where(step != 0, np.abs(1 / step), math.inf)
    travelled = 0.0
    while travelled <= reach:
        if (index >= 0).all() and (index < np.array(heights.shape[::-1]) - 1).all():
            distance = _through_cell(heights, cell, terrain.origin, index, origin, direction)
            if distance < math.inf:
                return distance
        axis = int(to_border[1] < to_border[0])
        travelled = to_border[axis]
        index[axis] += forward[axis]
        to_border[axis] += between[axis]
    return math.inf


def _through_cell(heights, cell, corner, index, origin, direction) -> float:
    """Where a ray meets one of a cell's two triangles (Moeller and Trumbore, 1997)."""
    i, j = index
    corners = {
        (a, b): np.array((corner[0] + (i + a) * cell, corner[1] + (j + b) * cell, heights[j + b, i + a]))
        for a in (0, 1)
        for b in (0, 1)
    }
    nearest = math.inf
    for first in ((0, 0), (1, 1)):
        a, one, two = corners[first], corners[1, 0] - corners[first], corners[0, 1] - corners[first]
        across = np.cross(direction, two)
        determinant = one @ across
        if determinant:
            u = (origin - a) @ across / determinant
            around = np.cross(origin - a, one)
            v, distance = direction @ around / determinant, two @ around / determinant
            if u >= 0 and v >= 0 and u + v <= 1 and 0 <= distance < nearest:
                nearest = distance
    return nearest
