"""Test for points inside the solids of a world: below the ground or in an obstacle."""

from __future__ import annotations

import numpy as np
import torch

from rover_rl.worlds.world import World

CELL = 0.1
"""Side length of a cell of the height map, m."""


class SolidTest:
    """Fast test for points inside the solids of one world.

    :meth:`World.inside` compares every point with every obstacle. This test first compares the height of a point with
    an upper bound of the height of all solids in its cell of a grid, which excludes almost all points.
    """

    def __init__(self, world: World) -> None:
        self._world = world
        (x_low, x_high), (y_low, y_high) = world.terrain.extent
        xs = np.arange(x_low - 1, x_high + 1, CELL)
        ys = np.arange(y_low - 1, y_high + 1, CELL)
        self._origin = np.array((xs[0], ys[0]))
        # The terrain in a cell is no higher than the nearest vertex of the terrain and its neighbors.
        heights = torch.nn.functional.max_pool2d(world.terrain.heights[None, None], 3, 1, 1)[0, 0].numpy()
        (x0, y0), cell = world.terrain.origin, world.terrain.cell
        i = np.clip(np.rint((xs + CELL / 2 - x0) / cell).astype(int), 0, heights.shape[1] - 1)
        j = np.clip(np.rint((ys + CELL / 2 - y0) / cell).astype(int), 0, heights.shape[0] - 1)
        self._heights = heights[np.ix_(j, i)]
        for obstacle in world.obstacles:
            low, high = obstacle.vertices.min(0).values.numpy(), obstacle.vertices.max(0).values.numpy()
            (left, bottom), (right, top) = self._cells(low[None])[0], self._cells(high[None])[0] + 1
            block = self._heights[bottom:top, left:right]
            np.maximum(block, high[2], out=block)

    def contains(self, points: np.ndarray) -> np.ndarray:
        """Returns which of ``points [k, 3]`` (m, float64) are inside a solid: bool ``[k]``."""
        cells = self._cells(points)
        inside = points[:, 2] <= self._heights[cells[:, 1], cells[:, 0]]
        if inside.any():
            inside[inside] = self._world.inside(torch.from_numpy(points[inside])).numpy()
        return inside

    def _cells(self, points: np.ndarray) -> np.ndarray:
        cells = ((points[:, :2] - self._origin) / CELL).astype(int)
        return np.clip(cells, 0, (self._heights.shape[1] - 1, self._heights.shape[0] - 1))
