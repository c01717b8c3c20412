"""The lidar: ``rayTestBatch`` in a client that holds the static geometry alone.

In the rovers' own client every ray would also visit the boxes of all rovers in the broad phase.
"""

from __future__ import annotations

import gc
from collections.abc import Iterator
from contextlib import contextmanager
from operator import itemgetter

import numpy as np
import torch

from rover_rl.sims.bullet.geometry import add_mesh_bodies
from rover_rl.sims.native.bullet import pybullet
from rover_rl.sims.robots import Robot
from rover_rl.sims.worlds import World

RAYS_PER_CALL = 1024
"""Rays in one call. The answer is ten objects a ray: few of them stay in the processor's cache, which makes reading and
freeing them a fifth cheaper. From 16,384 rays on, ``rayTestBatch`` would return nothing and raise no error."""

RAYS_AT_ONCE = 8192
"""Rays that are worked out at once."""

_CEILING_CELL = 0.1
_fraction = itemgetter(2)


class Lidar:
    """Scans the static geometry of one world.

    Args:
        world: what is scanned.
        robot: gives the lidar's mount and range.
        angles: direction of each beam in the rover's frame, ``[beams]``, rad.
    """

    def __init__(self, world: World, robot: Robot, angles: np.ndarray) -> None:
        self.client = pybullet.connect(pybullet.DIRECT)
        add_mesh_bodies(self.client, world)
        self._world = world
        self._mount = np.array(robot.lidar_position)
        self._range = robot.lidar_range
        self._directions = self._range * np.stack((np.cos(angles), np.sin(angles)))
        self._ceiling = _Ceiling(world)
        # Used again and again: fresh memory would be paged in anew.
        rovers = max(1, RAYS_AT_ONCE // len(angles))
        self._starts, self._ends = np.empty((2, rovers, len(angles), 3))

    def scan(self, position: np.ndarray, rotation: np.ndarray) -> np.ndarray:
        """Ranges ``[k, beams]`` (m) of rovers whose base frames are at ``position [k, 3]``, ``rotation [k, 3, 3]``.

        ``inf`` where nothing is hit, 0 for all beams of a lidar that is inside something.
        """
        origins = position + (rotation * self._mount).sum(-1)
        ranges = self._range * self._cast(origins, rotation)
        ranges[ranges >= self._range] = np.inf
        suspects = self._ceiling.above(origins)
        if suspects.any():
            rows = np.flatnonzero(suspects)
            inside = self._world.inside(torch.from_numpy(origins[rows])).numpy()
            ranges[rows[inside]] = 0.0
        return ranges

    def _cast(self, origins: np.ndarray, rotation: np.ndarray) -> np.ndarray:
        """Fraction of each ray that is free, 1 for all of it: ``[k, beams]``."""
        fractions = np.empty((len(origins), self._directions.shape[1]))
        rovers = len(self._starts)
        with _collector_paused():
            for first in range(0, len(origins), rovers):
                part = slice(first, first + rovers)
                self._cast_some(origins[part], rotation[part], fractions[part].reshape(-1))
        return fractions

    def _cast_some(self, origins: np.ndarray, rotation: np.ndarray, fractions: np.ndarray) -> None:
        """Fills ``fractions [k * beams]`` for as many rovers as there is room for in the buffers of rays."""
        starts, ends = self._starts[: len(origins)], self._ends[: len(origins)]
        ahead, left = self._directions
        starts[...] = origins[:, None]
        np.multiply(ahead[:, None], rotation[:, None, :, 0], out=ends)
        ends += left[:, None] * rotation[:, None, :, 1]
        ends += starts
        starts, ends = starts.reshape(-1, 3), ends.reshape(-1, 3)
        for ray in range(0, len(starts), RAYS_PER_CALL):
            some = slice(ray, ray + RAYS_PER_CALL)
            hits = pybullet.rayTestBatch(starts[some], ends[some], physicsClientId=self.client)
            if len(hits) != len(starts[some]):
                raise RuntimeError(f"Bullet answered {len(hits)} of {len(starts[some])} lidar rays")
            fractions[some] = np.fromiter(map(_fraction, hits), np.float64, len(hits))


class _Ceiling:
    """Highest solid point of each cell of a world: a cheap test that spares most points the exact one."""

    def __init__(self, world: World) -> None:
        (x_low, x_high), (y_low, y_high) = world.terrain.extent
        xs = np.arange(x_low - 1, x_high + 1, _CEILING_CELL)
        ys = np.arange(y_low - 1, y_high + 1, _CEILING_CELL)
        self._origin = np.array((xs[0], ys[0]))
        # The highest terrain point of a cell is no higher than that of the terrain's own grid cell and its neighbours.
        heights = torch.nn.functional.max_pool2d(world.terrain.heights[None, None], 3, 1, 1)[0, 0].numpy()
        (x0, y0), cell = world.terrain.origin, world.terrain.cell
        i = np.clip(np.rint((xs + _CEILING_CELL / 2 - x0) / cell).astype(int), 0, heights.shape[1] - 1)
        j = np.clip(np.rint((ys + _CEILING_CELL / 2 - y0) / cell).astype(int), 0, heights.shape[0] - 1)
        self._heights = heights[np.ix_(j, i)]
        for obstacle in world.obstacles:
            low, high = obstacle.vertices.min(0).values.numpy(), obstacle.vertices.max(0).values.numpy()
            (left, bottom), (right, top) = self._cells(low[None])[0], self._cells(high[None])[0] + 1
            block = self._heights[bottom:top, left:right]
            np.maximum(block, high[2], out=block)

    def above(self, points: np.ndarray) -> np.ndarray:
        """Which of ``points [k, 3]`` may be inside something, as some solid in their cell is higher: bool ``[k]``."""
        cells = self._cells(points)
        return points[:, 2] <= self._heights[cells[:, 1], cells[:, 0]]

    def _cells(self, points: np.ndarray) -> np.ndarray:
        cells = ((points[:, :2] - self._origin) / _CEILING_CELL).astype(int)
        return np.clip(cells, 0, (self._heights.shape[1] - 1, self._heights.shape[0] - 1))


@contextmanager
def _collector_paused() -> Iterator[None]:
    """A scan makes hundreds of thousands of tuples that die at once; the collector would walk over them for nothing."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()
