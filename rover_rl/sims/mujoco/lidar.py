"""Lidar with ``mj_multiRay``, in a MuJoCo model that contains only the static geometry."""

from __future__ import annotations

import numpy as np

from rover_rl.native.mujoco import mujoco
from rover_rl.robots import Robot
from rover_rl.sims.mujoco.geometry import add_ground_tiles, add_obstacles
from rover_rl.worlds import World
from rover_rl.worlds.clearance import SolidTest

NUDGE = np.array((1.3e-6, 0.7e-6, 0.0))
"""Shift of all rays, m. A ray exactly along the edge of two triangles may miss both, and edges are on round numbers."""


class RayScene:
    """Static geometry of a world for lidar rays of a length ``reach`` (m). Several lidars share it."""

    def __init__(self, world: World, reach: float) -> None:
        spec = mujoco.MjSpec()
        add_ground_tiles(spec, world, reach)
        add_obstacles(spec, world)
        self.model, self.solids = spec.compile(), SolidTest(world.terrain, world.obstacles)


class MujocoLidar:
    """Lidar that scans one scene, with beams at ``angles [beams]`` (rad) from straight ahead, for one thread."""

    def __init__(self, scene: RayScene, robot: Robot, angles: np.ndarray) -> None:
        self._scene = scene
        self._data = mujoco.MjData(scene.model)
        mujoco.mj_forward(scene.model, self._data)
        self._mount, self._range = np.array(robot.lidar_position), robot.lidar_range
        self._ahead, self._left = np.cos(angles)[:, None], np.sin(angles)[:, None]
        self._hits = np.empty(len(angles), dtype=np.int32)

    def scan(self, position: np.ndarray, orientation: np.ndarray) -> np.ndarray:
        """Scans from base frames at positions ``[k, 3]`` (m), with quaternions (w, x, y, z) ``[k, 4]``."""
        matrices = np.empty((len(orientation), 9))
        for matrix, quaternion in zip(matrices, orientation, strict=True):
            mujoco.mju_quat2Mat(matrix, quaternion)
        rotation = matrices.reshape(-1, 3, 3)
        origins = position + (rotation * self._mount).sum(-1)
        ranges = np.empty((len(origins), len(self._hits)))
        for origin, (forward, left), row in zip(origins, rotation.transpose(0, 2, 1)[:, :2], ranges, strict=True):
            rays = origin + NUDGE, (self._ahead * forward + self._left * left).reshape(-1)
            # Of all groups, static ones too, and all bodies. Results are geoms and distances, no normals.
            filters, results = (None, True, -1), (self._hits, row, None)
            mujoco.mj_multiRay(self._scene.model, self._data, *rays, *filters, *results, len(row), self._range)
        # MuJoCo returns -1 for a ray that hits nothing.
        ranges[(ranges < 0) | (ranges >= self._range)] = np.inf
        ranges[self._scene.solids.contains(origins)] = 0.0
        return ranges
