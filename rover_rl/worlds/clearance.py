"""Where the obstacles of a world are: horizontal distances to them, and points inside of them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from rover_rl.worlds.solids import Solids
from rover_rl.worlds.terrain import Terrain

NEAR_GROUND = 0.5
"""Maximum height above and depth below the ground at which obstacles count, m."""
CELL = 0.1
"""Side length of a cell of the height map of :class:`SolidTest`, m."""


def clearance_on_grid(
    terrain: Terrain, obstacles: Sequence[Solids], xs: np.ndarray, ys: np.ndarray, limit: float
) -> Tensor:
    """Returns the horizontal distance from the points of a grid to the nearest obstacle near the ground.

    ``xs`` of the columns, at equal distances, and ``ys`` of the rows are float64, m. Distances are 0 inside an obstacle
    and at most ``limit``, float64 ``[rows, columns]``, m.
    """
    # Importing NVIDIA Warp takes half a second.
    from rover_rl.native.warp import wp
    from rover_rl.worlds.ground_kernels import measure_clearance

    clearance = torch.full((len(ys), len(xs)), limit, dtype=torch.float64)
    solids = Solids.of(obstacles)
    near = _is_near_ground(terrain, solids)
    outlines = [outline for outline, counts in zip(solids.outlines, near, strict=True) if counts]
    if outlines:
        corners, starts = np.concatenate(outlines), np.cumsum([0, *map(len, outlines)]).astype(np.int32)
        boxes = np.hstack([ends.reduceat(corners, starts[:-1]) for ends in (np.minimum, np.maximum)])
        inputs = [xs, ys, corners, starts, boxes, limit, clearance.numpy()]
        wp.launch(measure_clearance, dim=len(ys), inputs=inputs, device="cpu")
    return clearance


def _is_near_ground(terrain: Terrain, solids: Solids) -> np.ndarray:
    """Which solids may reach a rover's height, conservatively by their bounding boxes: bool ``[N]``."""
    low, high = solids.bounding_boxes
    if terrain.is_flat or not len(low):
        lowest = highest = np.full(len(low), terrain.heights[0, 0].item())
    else:
        from rover_rl.native.warp import wp
        from rover_rl.worlds.ground_kernels import ground_of, measure_extremes

        steps = np.minimum(200, np.ceil((high - low)[:, :2].max(1) / terrain.cell) * 2 + 1).astype(np.int32)
        extremes = np.empty((len(low), 2))
        corners = (np.ascontiguousarray(corner[:, :2]) for corner in (low, high))
        wp.launch(measure_extremes, len(low), [ground_of(terrain), *corners, steps, extremes], device="cpu")
        lowest, highest = extremes.T
    return (low[:, 2] <= highest + NEAR_GROUND) & (high[:, 2] >= lowest - NEAR_GROUND)


class SolidTest:
    """Fast test for points below the ground or in an obstacle of one world.

    :meth:`World.inside` compares every point with every obstacle. This test first compares the height of a point with
    an upper bound of the height of all solids in its cell of a grid, which excludes almost all points.
    """

    def __init__(self, terrain: Terrain, obstacles: Sequence[Solids]) -> None:
        self._terrain, self._solids = terrain, Solids.of(obstacles)
        xs, ys = (np.arange(low - 1, high + 1, CELL) for low, high in terrain.extent)
        self._origin = np.array((xs[0], ys[0]))
        # The terrain in a cell is no higher than the nearest vertex of the terrain and its neighbors.
        heights = torch.nn.functional.max_pool2d(terrain.heights[None, None], 3, 1, 1)[0, 0].numpy()
        i, j = (
            np.clip(np.rint((axis + CELL / 2 - start) / terrain.cell).astype(int), 0, count - 1)
            for axis, start, count in zip((xs, ys), terrain.origin, heights.shape[::-1], strict=True)
        )
        self._heights = heights[np.ix_(j, i)]
        lows, highs = self._solids.bounding_boxes
        corners = zip(self._cells(lows), self._cells(highs) + 1, highs[:, 2], strict=True)
        for (left, bottom), (right, top), height in corners:
            block = self._heights[bottom:top, left:right]
            np.maximum(block, height, out=block)

    def contains(self, points: np.ndarray) -> np.ndarray:
        """Returns which of ``points [k, 3]`` (m, float64) are inside a solid: bool ``[k]``."""
        cells = self._cells(points)
        inside = points[:, 2] <= self._heights[cells[:, 1], cells[:, 0]]
        if inside.any():
            near = torch.from_numpy(points[inside])
            below = near[:, 2] < self._terrain.height_at(near[:, :2])
            inside[inside] = (below | self._solids.contains(near)).numpy()
        return inside

    def _cells(self, points: np.ndarray) -> np.ndarray:
        cells = ((points[:, :2] - self._origin) / CELL).astype(int)
        return np.clip(cells, 0, (self._heights.shape[1] - 1, self._heights.shape[0] - 1))
