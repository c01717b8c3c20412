"""Pictures of a rover in its world, by Bullet's software renderer: no display and no GPU needed."""

from __future__ import annotations

import weakref

import numpy as np
import torch
from torch import Tensor

from rover_rl.sims.base import View
from rover_rl.sims.native.bullet import disconnect, pybullet
from rover_rl.sims.native.shapes import make_visual_mesh, terrain_strips
from rover_rl.sims.rendering.camera import FIELD_OF_VIEW, NEAR, Camera
from rover_rl.sims.robots import Robot
from rover_rl.sims.worlds import World

_GROUND = (0.62, 0.56, 0.48, 1.0)
_OBSTACLE = (0.45, 0.52, 0.60, 1.0)
_GOAL = (0.10, 0.75, 0.25, 1.0)


class Renderer:
    """A client of its own with what can be seen: the physics carries no pictures along.

    Args:
        world: what is around the rover.
        robot: the rover.
    """

    def __init__(self, world: World, robot: Robot) -> None:
        self.client = pybullet.connect(pybullet.DIRECT)
        self._finalizer = weakref.finalize(self, disconnect, [self.client])
        self._world = world
        self._add_scenery()
        self._rover = pybullet.loadURDF(str(robot.urdf), physicsClientId=self.client)
        info = pybullet.getDynamicsInfo(self._rover, -1, physicsClientId=self.client)
        self._inertial = info[3], info[4]
        post = pybullet.createVisualShape(
            pybullet.GEOM_CYLINDER, radius=0.08, length=1.2, rgbaColor=_GOAL, physicsClientId=self.client
        )
        self._goal = pybullet.createMultiBody(0, -1, post, physicsClientId=self.client)

    def picture(
        self,
        position: np.ndarray,
        orientation: np.ndarray,
        view: View,
        width: int,
        height: int,
        goal: list[float] | None,
    ) -> Tensor:
        """What a camera behind (``"chase"``) or high above (``"top"``) the rover sees: uint8 ``[height, width, 3]``.

        Raises:
            ValueError: for another view.
        """
        camera = Camera.on(torch.from_numpy(position), torch.from_numpy(orientation), self._world, view)
        self._pose(position, orientation, goal)
        _, _, rgba, _, _ = pybullet.getCameraImage(
            width,
            height,
            pybullet.computeViewMatrix(camera.eye.tolist(), camera.target.tolist(), camera.up.tolist()),
            pybullet.computeProjectionMatrixFOV(FIELD_OF_VIEW, width / height, NEAR, 60),
            lightDirection=(-3, 2, 6),
            # Shadow maps of this renderer cover large flat ground with stripes.
            shadow=0,
            renderer=pybullet.ER_TINY_RENDERER,
            physicsClientId=self.client,
        )
        pixels = np.asarray(rgba, dtype=np.uint8).reshape(height, width, 4)[:, :, :3]
        return torch.from_numpy(pixels.copy())

    def close(self) -> None:
        """Disconnects its client; may be called again."""
        self._finalizer()

    def _pose(self, position: np.ndarray, orientation: np.ndarray, goal: list[float] | None) -> None:
        center = pybullet.multiplyTransforms(position.tolist(), orientation.tolist(), *self._inertial)
        pybullet.resetBasePositionAndOrientation(self._rover, *center, physicsClientId=self.client)
        below = (0.0, 0.0, -1e3)
        place = below
        if goal is not None:
            ground = self._world.height_at(torch.tensor(goal, dtype=torch.float64)).item()
            place = (goal[0], goal[1], ground + 0.6)
        pybullet.resetBasePositionAndOrientation(self._goal, place, (0, 0, 0, 1), physicsClientId=self.client)

    def _add_scenery(self) -> None:
        terrain = self._world.terrain
        for strip in terrain_strips(terrain):
            self._add_mesh(*terrain.mesh(*strip), colour=_GROUND)
        for obstacle in self._world.obstacles:
            # Corners of their own for every face give the flat shading of a solid with edges.
            corners = obstacle.vertices[obstacle.faces.flatten()]
            self._add_mesh(corners, torch.arange(len(corners)).reshape(-1, 3), colour=_OBSTACLE)

    def _add_mesh(self, vertices: Tensor, faces: Tensor, colour: tuple[float, float, float, float]) -> None:
        a, b, c = (vertices[faces[:, k]] for k in range(3))
        flat = torch.linalg.cross(b - a, c - a)
        normals = torch.zeros_like(vertices)
        for k in range(3):
            normals.index_add_(0, faces[:, k], flat)
        normals = normals / normals.norm(dim=-1, keepdim=True)
        shape = make_visual_mesh(self.client, vertices.numpy(), faces.numpy(), normals.numpy(), colour)
        pybullet.createMultiBody(0, -1, shape, physicsClientId=self.client)
