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


class Scene:
    """Static geometry of a world for lidar rays. Several :class:`Lidar` share it.

    Args:
        world: world to scan.
        reach: length of the rays, m.

    Attributes:
        model: MuJoCo model of the geometry.
        solids: test for points inside the solids of the world.
    """

    def __init__(self, world: World, reach: float) -> None:
        spec = mujoco.MjSpec()
        add_ground_tiles(spec, world, reach)
        add_obstacles(spec, world)
        self.model = spec.compile()
        self.solids = SolidTest(world)


class Lidar:
    """Lidar that scans one scene. A thread uses one of its own.

    Args:
        scene: scene to scan.
        robot: robot that defines the position and range of the lidar.
        angles: direction of each beam in the rover's frame, ``[beams]``, rad.
    """

    def __init__(self, scene: Scene, robot: Robot, angles: np.ndarray) -> None:
        self._scene = scene
        self._data = mujoco.MjData(scene.model)
        mujoco.mj_forward(scene.model, self._data)
        self._mount = np.array(robot.lidar_position)
        self._range = robot.lidar_range
        self._ahead, self._left = np.cos(angles)[:, None], np.sin(angles)[:, None]
        self._hits = np.empty(len(angles), dtype=np.int32)

    def scan(self, position: np.ndarray, orientation: np.ndarray) -> np.ndarray:
        """Scans from the given poses.

        Args:
            position: positions of the base frames, ``[k, 3]``, m.
            orientation: orientations of the base frames, quaternions (w, x, y, z), ``[k, 4]``.

        Returns:
            Ranges ``[k, beams]``, m: ``inf`` where a beam hits nothing, 0 for all beams of a lidar inside a solid.
        """
        matrices = np.empty((len(orientation), 9))
        for matrix, quaternion in zip(matrices, orientation, strict=True):
            mujoco.mju_quat2Mat(matrix, quaternion)
        rotation = matrices.reshape(-1, 3, 3)
        origins = position + (rotation * self._mount).sum(-1)
        ranges = np.empty((len(origins), len(self._hits)))
        for origin, (forward, left), row in zip(origins, rotation.transpose(0, 2, 1)[:, :2], ranges, strict=True):
            self._cast(origin, self._ahead * forward + self._left * left, row)
        # MuJoCo returns -1 for a ray that hits nothing.
        ranges[(ranges < 0) | (ranges >= self._range)] = np.inf
        ranges[self._scene.solids.contains(origins)] = 0.0
        return ranges

    def _cast(self, origin: np.ndarray, directions: np.ndarray, distances: np.ndarray) -> None:
        """Writes the distances (m) along unit vectors ``[beams, 3]`` to the nearest geoms, ``[beams]``."""
        mujoco.mj_multiRay(
            self._scene.model,
            self._data,
            pnt=origin + NUDGE,
            vec=directions.reshape(-1),
            geomgroup=None,
            flg_static=True,
            bodyexclude=-1,
            geomid=self._hits,
            dist=distances,
            normal=None,
            nray=len(distances),
            cutoff=self._range,
        )
