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

RAYS_PER_CALL = 512
"""Rays in one call of ``rayTestBatch``. It returns ten objects a ray: few enough of them stay in the processor's
cache, which makes reading and freeing them a fifth cheaper than at the limit of 16,383 rays, beyond which it returns
nothing and raises no error."""

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
        self._reach_ahead = self._range * np.cos(angles)[None, :, None]
        self._reach_left = self._range * np.sin(angles)[None, :, None]
        self._ceiling = _Ceiling(world)
        self._starts = self._ends = self._aside = np.empty((0, len(angles), 3))

    def scan(self, position: np.ndarray, rotation: np.ndarray) -> np.ndarray:
        """Ranges ``[k, beams]`` (m) of rovers whose base frames are at ``position [k, 3]``, ``rotation [k, 3, 3]``.

        ``inf`` where nothing is hit, 0 for all beams of a lidar that is inside something.
        """
        origins = position + (rotation * self._mount).sum(-1)
        starts, ends = self._rays(origins, rotation[:, None, :, 0], rotation[:, None, :, 1])
        fractions = self._cast(starts.reshape(-1, 3), ends.reshape(-1, 3))
        ranges = np.where(fractions < 1, fractions * self._range, np.inf).reshape(len(origins), -1)
        suspects = self._ceiling.above(origins)
        if suspects.any():
            rows = np.flatnonzero(suspects)
            inside = self._world.inside(torch.from_numpy(origins[rows])).numpy()
            ranges[rows[inside]] = 0.0
        return ranges

    def _rays(self, origins: np.ndarray, forward: np.ndarray, left: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Start and end of every ray, ``[k, beams, 3]``, in buffers that the next scan overwrites."""
        if len(self._starts) < len(origins):
            self._starts, self._ends, self._aside = (
                np.empty((len(origins), self._reach_ahead.shape[1], 3)) for _ in range(3)
            )
        starts, ends, aside = (buffer[: len(origins)] for buffer in (self._starts, self._ends, self._aside))
        starts[:] = origins[:, None]
        np.multiply(self._reach_ahead, forward, out=ends)
        np.multiply(self._reach_left, left, out=aside)
        ends += aside
        ends += starts
        return starts, ends

    def _cast(self, starts: np.ndarray, ends: np.ndarray) -> np.ndarray:
        """Fraction of each ray that is free, 1 for all of it: ``[rays]``."""
        fractions = np.empty(len(starts))
        with _collector_paused():
            for first in range(0, len(starts), RAYS_PER_CALL):
                part = slice(first, min(first + RAYS_PER_CALL, len(starts)))
                count = part.stop - first
                hits = pybullet.rayTestBatch(starts[part], ends[part], physicsClientId=self.client)
                if len(hits) != count:
                    raise RuntimeError(f"Bullet answered {len(hits)} of {count} lidar rays")
                fractions[part] = np.fromiter(map(_fraction, hits), np.float64, count)
            # Freed before the collector is back, which would walk over them.
            del hits
        return fractions


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
