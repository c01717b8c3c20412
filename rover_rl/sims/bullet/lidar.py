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
from rover_rl.sims.bullet.library import pybullet
from rover_rl.sims.robots import Robot
from rover_rl.sims.worlds import World

MAX_RAYS = 16_383
"""Rays in one call at most: beyond that, ``rayTestBatch`` returns nothing and raises no error."""

RAYS_PER_CALL = 1024
"""Rays in one call if a scan has fewer beams. The answer is ten objects a ray: few of them stay in the processor's
cache, which makes reading and freeing them a fifth cheaper."""

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
        beams = self._directions.shape[1]
        fractions = np.empty((len(origins), beams))
        together = max(1, RAYS_PER_CALL // beams)
        with _collector_paused():
            for first in range(0, len(origins), together):
                part = slice(first, first + together)
                starts, ends = self._rays(origins[part], rotation[part])
                for ray in range(0, len(starts), MAX_RAYS):
                    some = slice(ray, ray + MAX_RAYS)
                    hits = pybullet.rayTestBatch(starts[some], ends[some], physicsClientId=self.client)
                    if len(hits) != len(starts[some]):
                        raise RuntimeError(f"Bullet answered {len(hits)} of {len(starts[some])} lidar rays")
                    free = np.fromiter(map(_fraction, hits), np.float64, len(hits))
                    fractions[part].reshape(-1)[some] = free
            # Freed before the collector is back, which would walk over them.
            del hits
        return fractions

    def _rays(self, origins: np.ndarray, rotation: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Start and end of every ray, ``[k * beams, 3]``."""
        ahead, left = self._directions
        ends = ahead[:, None] * rotation[:, None, :, 0]
        ends += left[:, None] * rotation[:, None, :, 1]
        ends += origins[:, None]
        starts = np.repeat(origins, len(ahead), axis=0)
        return starts, ends.reshape(-1, 3)


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
