"""Renderer: a ray tracer in NVIDIA Warp, which needs neither a display nor a GPU."""

from __future__ import annotations

from threading import Lock

import torch
from torch import Tensor

from rover_rl.native.warp import wp
from rover_rl.robots import Robot
from rover_rl.sims.rendering import kernels
from rover_rl.sims.rendering.camera import Camera, Sight, focal_length
from rover_rl.sims.rendering.scenes import DEVICE, TracedShapes, TracedWorld, launch
from rover_rl.sims.rendering.surfaces import forms_of, post_surface, robot_surface
from rover_rl.worlds import World
from rover_rl.worlds.movers.parts import Parts

ROBOT, POST = 0, 1
"""Numbers of the first shapes."""


class Renderer:
    """Renderer of a robot in one world. ``sight`` tells which points the obstacles hide."""

    def __init__(self, world: World, robot: Robot) -> None:
        # Here, as it must not happen in two threads at a time.
        wp.load_module(kernels, device=DEVICE)
        self._world, self._lock = world, Lock()
        self._scenery = TracedWorld(world)
        self._shapes = TracedShapes([robot_surface(robot), post_surface()])
        self.sight = Sight(world)

    def render_from(
        self,
        camera: Camera,
        position: Tensor,
        orientation: Tensor,
        width: int,
        height: int,
        goal: Tensor | None = None,
        movers: Parts | None = None,
    ) -> Tensor:
        """Renders what a camera sees: see ``RendererCache.render``. Several threads may call it."""
        poses, numbers = [torch.cat((position, orientation)).float()], [ROBOT]
        if goal is not None:
            foot = (*goal.tolist(), self._world.height_at(goal.double().cpu()).item())
            poses, numbers = [*poses, torch.tensor((*foot, 0.0, 0.0, 0.0, 1.0))], [*numbers, POST]
        with self._lock:
            if movers is not None:
                forms = forms_of(self._world, movers)
                for part in movers.in_view(camera.eye.numpy()).tolist():
                    poses.append(torch.cat((movers.position[0, part], movers.orientation[0, part])))
                    numbers.append(self._shapes.number(forms[part]))
            chosen = torch.tensor(numbers, dtype=torch.int32)
            reaches = torch.tensor(self._shapes.reaches)[chosen.long()]
            bodies, _tree = self._shapes.bodies(torch.stack(poses), chosen, reaches)
        colors = wp.empty((height, width), dtype=wp.vec3, device=DEVICE)
        picture = torch.empty((height, width, 3), dtype=torch.uint8)
        scene = [self._scenery.scenery, bodies, _pinhole(camera, height), colors]
        launch(kernels.trace_pixels, (height, width), scene)
        launch(kernels.smooth_edges, (height, width), [*scene, wp.from_torch(picture)])
        return picture


def _pinhole(camera: Camera, height: int) -> kernels.Pinhole:
    """Converts a camera for images of the given height in pixels."""
    right, down, forward = camera.axes
    focal = focal_length(height)
    pinhole = kernels.Pinhole()
    pinhole.eye, pinhole.forward = wp.vec3(*camera.eye.tolist()), wp.vec3(*forward.tolist())
    pinhole.right, pinhole.down = wp.vec3(*(right / focal).tolist()), wp.vec3(*(down / focal).tolist())
    return pinhole
