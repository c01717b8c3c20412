"""Horizontal distances to the obstacles of a world."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch
from torch import Tensor

from rover_rl.worlds.obstacles import Obstacle, Solids, groups_of
from rover_rl.worlds.terrain import Terrain

if TYPE_CHECKING:
    from rover_rl.worlds.world import World

NEAR_GROUND = 0.5
"""Maximum height above and depth below the ground at which obstacles count, m."""


class Site(NamedTuple):
    """Ground with obstacles: what a world is before it has areas."""

    terrain: Terrain
    obstacles: Sequence[Obstacle]


def clearance_on_grid(world: World | Site, xs: np.ndarray, ys: np.ndarray, limit: float) -> Tensor:
    """Returns the horizontal distance from the points of a grid to the nearest obstacle near the ground.

    Args:
        world: world with the obstacles.
        xs: x of the columns, at equal distances, float64 ``[columns]``, m.
        ys: y of the rows, float64 ``[rows]``, m.
        limit: largest distance of interest, m.

    Returns:
        Distances, 0 inside an obstacle and at most ``limit``, float64 ``[rows, columns]``, m.
    """
    # Importing NVIDIA Warp takes half a second.
    from rover_rl.native.warp import wp
    from rover_rl.worlds.ground_kernels import measure_clearance

    clearance = torch.full((len(ys), len(xs)), limit, dtype=torch.float64)
    outlines = [solids.outlines[_is_near_ground(world, solids)] for solids in groups_of(world.obstacles)]
    outlines = [group for group in outlines if len(group)]
    if outlines:
        middles = [group.mean(1) for group in outlines]
        radii = [np.linalg.norm(g - m[:, None], axis=-1).max(1) for g, m in zip(outlines, middles, strict=True)]
        starts = np.cumsum([0, *(group.shape[1] for group in outlines for _ in group)]).astype(np.int32)
        vertices = np.concatenate([group.reshape(-1, 2) for group in outlines])
        circles = np.column_stack((np.concatenate(middles), np.concatenate(radii)))
        inputs = [xs, ys, vertices, starts, circles, limit, clearance.numpy()]
        wp.launch(measure_clearance, dim=len(ys), inputs=inputs, device="cpu")
    return clearance


def _is_near_ground(world: World | Site, solids: Solids) -> np.ndarray:
    """Returns whether a part of each solid may be at a rover's height, conservatively by its bounding box: ``[N]``."""
    low, high = solids.vertices.numpy().min(1), solids.vertices.numpy().max(1)
    if world.terrain.is_flat:
        lowest = highest = np.full(len(solids), world.terrain.heights[0, 0].item())
    else:
        lowest, highest = _ground_extremes(world.terrain, low[:, :2], high[:, :2]).T
    return (low[:, 2] <= highest + NEAR_GROUND) & (high[:, 2] >= lowest - NEAR_GROUND)


def _ground_extremes(terrain: Terrain, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Returns the least and the greatest height (m) of the ground in rectangles by their corners, from samples."""
    from rover_rl.native.warp import wp
    from rover_rl.worlds.ground_kernels import ground_of, measure_extremes

    steps = np.minimum(200, np.ceil((high - low).max(1) / terrain.cell) * 2 + 1).astype(np.int32)
    extremes = np.empty((len(low), 2))
    corners = (np.ascontiguousarray(corner) for corner in (low, high))
    wp.launch(measure_extremes, len(low), [ground_of(terrain), *corners, steps, extremes], device="cpu")
    return extremes
