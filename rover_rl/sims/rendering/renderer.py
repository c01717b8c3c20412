"""Renderer: a ray tracer in NVIDIA Warp, which needs neither a display nor a GPU."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from rover_rl.native.warp import wp
from rover_rl.robots import Robot
from rover_rl.sims.rendering.camera import Camera, Sight, focal_length
from rover_rl.sims.rendering.kernels import light, pictures, rays
from rover_rl.sims.rendering.kernels.pictures import STEP
from rover_rl.sims.rendering.launches import DEVICE, array, launch
from rover_rl.sims.rendering.mover_surfaces import MoverSurfaces
from rover_rl.sims.rendering.robot_surface import robot_surface
from rover_rl.sims.rendering.scenes import AT_ORIGIN, FAR_BELOW, scene_of, traced_mesh
from rover_rl.sims.rendering.surfaces import Surface, ground_surface, obstacles_surface, post_surface
from rover_rl.worlds import World
from rover_rl.worlds.movers.parts import Parts

OPENNESS_RAYS = 16
"""Number of rays of each vertex that tell how much of the sky it sees."""
SCENERY_REACH, BODY_REACH = 1.2, 0.25
"""Distance up to which the scenery, and any other body, hides the sky from its own vertices, m."""
SHADOW_RINGS = 2
"""Number of triangles between the border of a shadow and vertices that count as surely lit or surely in shadow."""


class Renderer:
    """Renderer of a robot in one world, with precomputed light. ``sight`` tells which points the obstacles hide."""

    def __init__(self, world: World, robot: Robot) -> None:
        self._world = world
        # Here, as it must not happen in two threads at a time.
        wp.load_module(pictures, device=DEVICE)
        ground, obstacles = ground_surface(world.terrain), obstacles_surface(world)
        scenery = ground if obstacles is None else Surface.join([ground, obstacles])
        bodies = [scenery, robot_surface(robot), post_surface()]
        self._meshes = [traced_mesh(body) for body in bodies]
        reaches = [SCENERY_REACH, *(BODY_REACH for _ in bodies[1:])]
        openness = [sky_openness(*each) for each in zip(self._meshes, bodies, reaches, strict=True)]
        sunshine = np.full(sum(map(len, openness)), 0.5)
        sunshine[: len(ground.vertices)] = sunlight(self._meshes[0], ground)
        lit = np.concatenate(openness), sunshine
        self._arrays = scene_of(world.terrain, len(ground.faces), bodies, self._meshes, *lit)
        self._movers = MoverSurfaces(world)
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
        pinhole = _pinhole(camera, height)
        rover = (*position.tolist(), *orientation.tolist())
        post = FAR_BELOW if goal is None else (*goal.tolist(), self._world.height_at(goal.double().cpu()).item())
        poses = np.array((AT_ORIGIN, rover, (*post, *AT_ORIGIN[3:])), dtype=np.float32)
        placing = rays.Placing()
        placing.poses = wp.array(poses, dtype=wp.transform, device=DEVICE)
        _tree = self._movers.place(placing, movers, camera.eye.numpy())
        colors = wp.empty((height, width), dtype=wp.vec3, device=DEVICE)
        # Samples surround all pixels.
        rows, columns = ((side - 1) // STEP + 2 for side in (height, width))
        samples = wp.empty((rows, columns), dtype=rays.Seen, device=DEVICE)
        picture = torch.empty((height, width, 3), dtype=torch.uint8)
        scene = [self._arrays, placing, pinhole]
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


def sky_openness(mesh: wp.Mesh, surface: Surface, reach: float) -> np.ndarray:
    """Computes the visible share of the sky for each vertex, ``[V]``."""
    # Points of a Fibonacci sphere have the same distance from one another.
    k = np.arange(OPENNESS_RAYS) + 0.5
    height, turn = 1 - 2 * k / OPENNESS_RAYS, math.pi * (1 + math.sqrt(5)) * k
    radius = np.sqrt(1 - height**2)
    directions = array(np.stack((radius * np.cos(turn), radius * np.sin(turn), height), -1), wp.vec3)
    openness = wp.empty(len(surface.vertices), dtype=float, device=DEVICE)
    inputs = [mesh.id, mesh.points, array(surface.normals, wp.vec3), directions, reach, openness]
    launch(light.find_openness, (len(surface.vertices),), inputs)
    return openness.numpy()


def sunlight(mesh: wp.Mesh, ground: Surface) -> np.ndarray:
    """Computes the light of the sun on each vertex of the ground: 1, 0 for shadow, or 0.5 near borders, ``[V]``."""
    sunshine = torch.empty(len(ground.vertices))
    inputs = [mesh.id, mesh.points, array(ground.normals, wp.vec3), wp.from_torch(sunshine)]
    launch(light.find_sunshine, sunshine.shape, inputs)
    corners = torch.from_numpy(ground.faces)
    low = high = sunshine
    for _ in range(SHADOW_RINGS):
        low, high = _spread(low, corners, "amin"), _spread(high, corners, "amax")
    return torch.where(low == high, low, 0.5).numpy()


def _spread(values: Tensor, corners: Tensor, reduce: str) -> Tensor:
    """Reduces the values of each vertex and of all vertices that share a triangle with it, ``[V]``."""
    of_triangles = getattr(values[corners], reduce)(1)
    return values.scatter_reduce(0, corners.flatten(), of_triangles.repeat_interleave(3), reduce)
