"""Reference lidar by ray casting: grid traversal of the terrain (Amanatides and Woo, 1987) and all obstacles."""

from __future__ import annotations

import math

import numpy as np

from rover_rl.sims.worlds import Obstacle, Terrain, World


def scan(world: World, origin: np.ndarray, rotation: np.ndarray, beams: int, reach: float) -> np.ndarray:
    """Ranges ``[beams]`` (m) from ``origin [3]``, ``inf`` without a hit; the lidar must be in free space."""
    angles = 2 * math.pi * np.arange(beams) / beams
    directions = np.stack((np.cos(angles), np.sin(angles), np.zeros(beams)), -1) @ rotation.T
    return np.array([_cast(world, origin, direction, reach) for direction in directions])


def _cast(world: World, origin: np.ndarray, direction: np.ndarray, reach: float) -> float:
    hits = [_hit_obstacle(obstacle, origin, direction) for obstacle in world.obstacles]
    distance = min([*hits, _hit_terrain(world.terrain, origin, direction, reach)])
    return distance if distance < reach else math.inf


def _hit_obstacle(obstacle: Obstacle, origin: np.ndarray, direction: np.ndarray) -> float:
    """Distance at which a ray enters a convex solid: the last plane that it crosses inward, before any outward."""
    planes = obstacle.planes.numpy()
    height, slope = planes[:, :3] @ origin + planes[:, 3], planes[:, :3] @ direction
    if (height[slope == 0] > 0).any():
        return math.inf
    enter = (-height[slope < 0] / slope[slope < 0]).max(initial=-math.inf)
    leave = (-height[slope > 0] / slope[slope > 0]).min(initial=math.inf)
    return enter if 0 <= enter <= leave else math.inf


def _hit_terrain(terrain: Terrain, origin: np.ndarray, direction: np.ndarray, reach: float) -> float:
    heights, cell = terrain.heights.double().numpy(), terrain.cell
    position, step = (origin[:2] - terrain.origin) / cell, direction[:2] / cell
    index = np.floor(position).astype(int)
    forward = np.where(step > 0, 1, -1)
    with np.errstate(divide="ignore", invalid="ignore"):
        to_border = np.where(step != 0, (index + (step > 0) - position) / step, math.inf)
        between = np.where(step != 0, np.abs(1 / step), math.inf)
    traveled = 0.0
    while traveled <= reach:
        if (index >= 0).all() and (index < np.array(heights.shape[::-1]) - 1).all():
            distance = _hit_cell(heights, cell, terrain.origin, index, origin, direction)
            if distance < math.inf:
                return distance
        axis = int(to_border[1] < to_border[0])
        traveled = to_border[axis]
        index[axis] += forward[axis]
        to_border[axis] += between[axis]
    return math.inf


def _hit_cell(heights, cell, corner, index, origin, direction) -> float:
    """Distance at which a ray hits one of the two triangles of a cell (Moeller and Trumbore, 1997)."""
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
