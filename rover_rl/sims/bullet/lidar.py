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
"""Rays in one call: with 16,384 ``rayTestBatch`` returns nothing, and no error."""

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

    def scan(self, positions: np.ndarray, orientations: np.ndarray) -> np.ndarray:
        """Ranges ``[k, beams]`` (m) of rovers whose base frames are at ``positions [k, 3]``, ``orientations [k, 4]``.

        ``inf`` where nothing is hit, 0 for all beams of a lidar that is inside something.
        """
        rotation = _matrix(orientations)
        forward, left, up = rotation[:, :, 0], rotation[:, :, 1], rotation[:, :, 2]
        x, y, z = self._mount
        origins = positions + x * forward + y * left + z * up
        ends = origins[:, None] + self._reach_ahead * forward[:, None] + self._reach_left * left[:, None]
        starts = np.broadcast_to(origins[:, None], ends.shape).reshape(-1, 3)
        fractions = self._cast(starts, ends.reshape(-1, 3)).reshape(ends.shape[:2])
        ranges = np.where(fractions < 1, fractions * self._range, np.inf)
        suspects = self._ceiling.above(origins)
        if suspects.any():
            rows = np.flatnonzero(suspects)
            inside = self._world.inside(torch.from_numpy(origins[rows])).numpy()
            ranges[rows[inside]] = 0.0
        return ranges

    def _cast(self, starts: np.ndarray, ends: np.ndarray) -> np.ndarray:
        """Fraction of each ray that is free, 1 for all of it: ``[rays]``."""
        fractions = np.empty(len(starts))
        with _collector_paused():
            for first in range(0, len(starts), MAX_RAYS):
                part = slice(first, min(first + MAX_RAYS, len(starts)))
                hits = pybullet.rayTestBatch(starts[part], ends[part], physicsClientId=self.client)
                if len(hits) != part.stop - first:
                    raise RuntimeError(f"Bullet answered {len(hits)} of {part.stop - first} lidar rays")
                fractions[part] = np.fromiter(map(_fraction, hits), np.float64, len(hits))
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
        (x0, y0), cell = world.terrain.origin, world.terrain.cell  # type: ignore[misc]
        i = np.clip(np.rint((xs + _CEILING_CELL / 2 - x0) / cell).astype(int), 0, heights.shape[1] - 1)
        j = np.clip(np.rint((ys + _CEILING_CELL / 2 - y0) / cell).astype(int), 0, heights.shape[0] - 1)
        self._heights = heights[np.ix_(j, i)]
        for obstacle in world.obstacles:
            low, high = obstacle.vertices.min(0).values.numpy(), obstacle.vertices.max(0).values.numpy()
            (left, bottom), (right, top) = self._cells(low[None])[0], self._cells(high[None])[0] + 1
            block = self._heights[bottom:top, left:right]
            np.maximum(block, high[2], out=block)

    def above(self, points: np.ndarray) -> np.ndarray:
        """Which of ``points [k, 3]`` may be inside something, because some solid in their cell is higher: bool ``[k]``."""
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


def _matrix(quaternions: np.ndarray) -> np.ndarray:
    """Rotation matrices ``[k, 3, 3]`` of unit quaternions ``[k, 4]``; columns are forward, left, up."""
    x, y, z, w = 2 * quaternions.T
    hx, hy, hz = quaternions.T[:3]
    xx, yy, zz, xy, xz, yz = x * hx, y * hy, z * hz, x * hy, x * hz, y * hz
    wx, wy, wz = w * hx, w * hy, w * hz
    matrix = np.empty((len(quaternions), 3, 3))
    matrix[:, 0] = np.stack((1 - yy - zz, xy - wz, xz + wy), 1)
    matrix[:, 1] = np.stack((xy + wz, 1 - xx - zz, yz - wx), 1)
    matrix[:, 2] = np.stack((xz - wy, yz + wx, 1 - xx - yy), 1)
    return matrix
