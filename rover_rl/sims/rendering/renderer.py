"""Rendering with Bullet's software renderer, which needs neither a display nor a GPU."""

from __future__ import annotations

import weakref

import numpy as np
import torch
from torch import Tensor

from rover_rl.sims.base import View
from rover_rl.sims.native.bullet import disconnect, pybullet
from rover_rl.sims.native.shapes import make_visual_mesh, terrain_strips
from rover_rl.sims.rendering.camera import FIELD_OF_VIEW, NEAR, Camera
from rover_rl.sims.rendering.scenery import FAR, GOAL, GROUND, OBSTACLE, POST_LENGTH, POST_RADIUS, SUN, post_position
from rover_rl.sims.robots import Robot
from rover_rl.sims.worlds import World


class Renderer:
    """Renderer of one world, in a Bullet client separate from the physics.

    Args:
        world: world to render.
        robot: robot model.
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
            pybullet.GEOM_CYLINDER,
            radius=POST_RADIUS,
            length=POST_LENGTH,
            rgbaColor=GOAL,
            physicsClientId=self.client,
        )
        self._goal = pybullet.createMultiBody(0, -1, post, physicsClientId=self.client)

    def render(
        self,
        position: Tensor,
        orientation: Tensor,
        view: View,
        width: int,
        height: int,
        goal: Tensor | None = None,
    ) -> Tensor:
        """Renders a rover at a pose, with a post at its goal.

        Args:
            position: position of the rover, ``[3]``, float64, m.
            orientation: orientation of the rover, unit quaternion (x, y, z, w), ``[4]``, float64.
            view: ``"chase"`` (from behind) or ``"top"`` (from above).
            width: width of the image, pixels.
            height: height of the image, pixels.
            goal: position of the goal, ``[2]``, m. ``None`` draws no goal.

        Returns:
            RGB image, uint8 ``[height, width, 3]``.

        Raises:
            ValueError: if the view is unknown.
        """
        camera = Camera.on(position, orientation, self._world, view)
        self._place(position, orientation, goal)
        _, _, rgba, _, _ = pybullet.getCameraImage(
            width,
            height,
            pybullet.computeViewMatrix(camera.eye.tolist(), camera.target.tolist(), camera.up.tolist()),
            pybullet.computeProjectionMatrixFOV(FIELD_OF_VIEW, width / height, NEAR, FAR),
            lightDirection=SUN,
            # The shadow maps of this renderer draw stripes on large flat ground.
            shadow=0,
            renderer=pybullet.ER_TINY_RENDERER,
            physicsClientId=self.client,
        )
        pixels = np.asarray(rgba, dtype=np.uint8).reshape(height, width, 4)[:, :, :3]
        return torch.from_numpy(pixels.copy())

    def close(self) -> None:
        """Disconnects the Bullet client. Idempotent."""
        self._finalizer()

    def _place(self, position: Tensor, orientation: Tensor, goal: Tensor | None) -> None:
        """Moves the rover, and the post of the goal, which is far below the ground if there is no goal."""
        inertial = pybullet.multiplyTransforms(position.tolist(), orientation.tolist(), *self._inertial)
        pybullet.resetBasePositionAndOrientation(self._rover, *inertial, physicsClientId=self.client)
        post = post_position(self._world, goal)
        pybullet.resetBasePositionAndOrientation(self._goal, post, (0, 0, 0, 1), physicsClientId=self.client)

    def _add_scenery(self) -> None:
        terrain = self._world.terrain
        for strip in terrain_strips(terrain):
            self._add_mesh(*terrain.mesh(*strip), color=GROUND)
        for obstacle in self._world.obstacles:
            # Separate vertices for every face give flat shading with visible edges.
            corners = obstacle.vertices[obstacle.faces.flatten()]
            self._add_mesh(corners, torch.arange(len(corners)).reshape(-1, 3), color=OBSTACLE)

    def _add_mesh(self, vertices: Tensor, faces: Tensor, color: tuple[float, float, float, float]) -> None:
        a, b, c = (vertices[faces[:, k]] for k in range(3))
        flat = torch.linalg.cross(b - a, c - a)
        normals = torch.zeros_like(vertices)
        for k in range(3):
            normals.index_add_(0, faces[:, k], flat)
        normals = normals / normals.norm(dim=-1, keepdim=True)
        shape = make_visual_mesh(self.client, vertices.numpy(), faces.numpy(), normals.numpy(), color)
        pybullet.createMultiBody(0, -1, shape, physicsClientId=self.client)
