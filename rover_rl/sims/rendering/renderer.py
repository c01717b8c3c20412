"""Renderer: a ray tracer in NVIDIA Warp, which needs neither a display nor a GPU."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from rover_rl.sims.native.warp import wp
from rover_rl.sims.rendering.camera import Camera, Sight, focal_length
from rover_rl.sims.rendering.kernels import pictures, rays
from rover_rl.sims.rendering.kernels.pictures import STEP
from rover_rl.sims.rendering.launches import DEVICE, launch
from rover_rl.sims.rendering.scene import RenderScene
from rover_rl.sims.robots import Robot
from rover_rl.sims.worlds import World

_AT_ORIGIN = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
"""Position and quaternion (x, y, z, w) of the scenery."""
_FAR_BELOW = (0.0, 0.0, -1e6)
"""Position of the post without a goal, out of sight, m."""


class Renderer:
    """Renderer of a robot in one world. ``sight`` tells which points the obstacles hide."""

    def __init__(self, world: World, robot: Robot) -> None:
        self._world = world
        # Here, as it must not happen in two threads at a time.
        wp.load_module(pictures, device=DEVICE)
        self._scene = RenderScene(world, robot)
        self.sight = Sight(world)

    def render_from(
        self, camera: Camera, position: Tensor, orientation: Tensor, width: int, height: int, goal: Tensor | None = None
    ) -> Tensor:
        """Renders what a camera sees: see ``RendererCache.render``. Several threads may call it."""
        pinhole = _pinhole(camera, height)
        rover = (*position.tolist(), *orientation.tolist())
        post = _FAR_BELOW if goal is None else (*goal.tolist(), self._world.height_at(goal.double().cpu()).item())
        poses = np.array((_AT_ORIGIN, rover, (*post, *_AT_ORIGIN[3:])), dtype=np.float32)
        colors = wp.empty((height, width), dtype=wp.vec3, device=DEVICE)
        # Samples surround all pixels.
        rows, columns = ((side - 1) // STEP + 2 for side in (height, width))
        samples = wp.empty((rows, columns), dtype=rays.Seen, device=DEVICE)
        picture = torch.empty((height, width, 3), dtype=torch.uint8)
        scene = [self._scene.arrays, wp.array(poses, dtype=wp.transform, device=DEVICE), pinhole]
        launch(pictures.trace_samples, (rows, columns), [*scene, height, width, samples])
        launch(pictures.fill_pixels, (height, width), [*scene, samples, colors])
        launch(pictures.smooth_edges, (height, width), [*scene, colors, wp.from_torch(picture)])
        return picture


def _pinhole(camera: Camera, height: int) -> rays.Pinhole:
    """Converts a camera for images of the given height in pixels."""
    right, down, forward = camera.axes
    focal = focal_length(height)
    pinhole = rays.Pinhole()
    pinhole.eye, pinhole.forward = wp.vec3(*camera.eye.tolist()), wp.vec3(*forward.tolist())
    pinhole.right, pinhole.down = wp.vec3(*(right / focal).tolist()), wp.vec3(*(down / focal).tolist())
    return pinhole
