"""Renderer: a ray tracer in NVIDIA Warp, what it traces rays against, and cameras that follow a rover.

It needs neither a display nor a GPU.
"""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import pairwise, product
from threading import Lock
from typing import Any

import numpy as np
import torch
from torch import Tensor

from rover_rl.native.warp import wp
from rover_rl.robots import Robot
from rover_rl.rotations import quaternion_to_euler
from rover_rl.sims.base import View
from rover_rl.sims.rendering import kernels, surfaces
from rover_rl.sims.rendering.surfaces import Form, Surface
from rover_rl.worlds import Solids, World
from rover_rl.worlds.movers.parts import Parts

FIELD_OF_VIEW = 60.0
"""Vertical field of view, degrees."""
NEAR = 0.05
"""Distance of the near plane from the camera, m."""
_TOP_HEIGHT = 12.0
"""Height of the top view's camera above the rover, m."""
_CHASE_DISTANCES = torch.tensor((2.55, 1.7, 1.1), dtype=torch.float64)
"""Distances of the chase view's camera from the rover, m. It comes nearer where none of the angles will do."""
_ELEVATIONS = torch.linspace(math.radians(30.5), math.radians(85), 20, dtype=torch.float64)
"""Elevation angles of the chase view, rad. The camera uses the first at which no obstacle hides the rover."""
_BODY_POINTS = torch.tensor(list(product((-0.3, 0.3), (-0.3, 0.3), (0.1, 0.3))), dtype=torch.float64)
"""Points of the rover that should be visible, forward, left and up from its origin, m."""
FREE_FRACTION = 0.98
"""Fraction of a line of sight that must be free, less than 1 because its end may lie on an obstacle."""
ROBOT, POST = 0, 1
"""Numbers of the first shapes."""
DEVICE = "cpu"
"""Device of films, the same on every machine, so that pictures are the same too."""
MAX_THREADS, BANDS_PER_THREAD = 8, 4
"""Largest number of threads, and of parts of a launch per thread, as some parts of a picture take longer."""
SMALL = 4096
"""Number of elements up to which threads take longer to start than to work."""


def launch(kernel: wp.Kernel, size: Sequence[int], inputs: Sequence[Any]) -> None:
    """Launches a kernel whose first argument is the first row of ``size``, on several threads, and waits for it."""
    threads = min(os.cpu_count() or 1, MAX_THREADS)
    count = BANDS_PER_THREAD * threads if math.prod(size) > SMALL else 1
    ends = np.linspace(0, size[0], count + 1).astype(int).tolist()
    sizes = [(first, (last - first, *size[1:])) for first, last in pairwise(ends) if last > first]
    bands = [wp.launch(kernel, part, [first, *inputs], device=DEVICE, record_cmd=True) for first, part in sizes]
    if count == 1:
        bands[0].launch()
        return
    # A new pool for each launch: threads do not survive a fork of the process.
    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(wp.Launch.launch, bands))


def array(values: Any, dtype: Any, device: Any = DEVICE) -> wp.array:
    return wp.array(np.asarray(values), dtype=dtype, device=device)


class TracedShape:
    """A surface on a device: ``shape`` is what kernels read, as long as this object lives.

    ``reach`` is the radius of a sphere around the origin that contains it, m.
    """

    def __init__(self, surface: Surface, device: Any = DEVICE, ground_faces: int = 0) -> None:
        points, normals = (array(values, wp.vec3, device) for values in (surface.vertices, surface.normals))
        self._mesh = wp.Mesh(points, array(surface.faces.flatten(), int, device), velocities=normals)
        self.shape = kernels.Shape()
        # Squares turn displayed colors into intensities.
        colors = np.column_stack((surface.colors**2, np.arange(len(surface.faces)) < ground_faces))
        self.shape.mesh, self.shape.colors = self._mesh.id, array(colors, wp.vec4, device)
        self.reach = float(np.linalg.norm(surface.vertices, axis=1).max())


class TracedWorld(TracedShape):
    """The ground and the obstacles of a world on a device, as ``scenery``."""

    def __init__(self, world: World, device: Any = DEVICE) -> None:
        ground, obstacles = surfaces.ground_surface(world.terrain), surfaces.obstacles_surface(world)
        surface = ground if obstacles is None else Surface.join([ground, obstacles])
        super().__init__(surface, device, len(ground.faces))
        heights = world.terrain.heights
        self.scenery = kernels.Scenery()
        self.scenery.shape = self.shape
        self.scenery.level = torch.cat((heights[0], heights[-1], heights[:, 0], heights[:, -1])).mean().item()


class TracedShapes:
    """Shapes of bodies on a device, by number: those given, and those of parts of movers, made when first asked for."""

    def __init__(self, first: Sequence[Surface], device: Any = DEVICE) -> None:
        self._device, self._numbers = device, dict[Form, int]()
        self._shapes = [TracedShape(surface, device) for surface in first]
        self._array: wp.array | None = None

    def number(self, form: Form) -> int:
        """Returns the number of the shape of parts of a form."""
        if form not in self._numbers:
            self._numbers[form] = len(self._shapes)
            self._shapes.append(TracedShape(surfaces.part_surface(form), self._device))
            self._array = None
        return self._numbers[form]

    @property
    def reaches(self) -> list[float]:
        """``reach`` of each shape, m."""
        return [one.reach for one in self._shapes]

    def bodies(self, poses: Tensor, numbers: Tensor, reaches: Tensor, rows: Tensor | None = None) -> tuple[Any, Any]:
        """Returns bodies for the kernels, and their tree, which must live as long.

        ``poses`` are ``[B, 7]``: position (m) and quaternion. ``numbers`` are those of their shapes, int32 ``[B]``,
        ``reaches`` radii of spheres around them, ``[B]``, m. With ``rows``, the tree has a branch for each row.
        """
        if self._array is None:
            shapes = [one.shape for one in self._shapes]
            self._array = wp.array(shapes, dtype=kernels.Shape, device=self._device)
        corners = [
            wp.from_torch((poses[:, :3] + sign * reaches[:, None]).contiguous(), dtype=wp.vec3) for sign in (-1, 1)
        ]
        tree = wp.Bvh(*corners, groups=None if rows is None else wp.from_torch(rows))
        bodies = kernels.Bodies()
        bodies.tree, bodies.root, bodies.shapes = tree.id, -1, self._array
        bodies.poses, bodies.numbers = wp.from_torch(poses, dtype=wp.transform), wp.from_torch(numbers)
        return bodies, tree


class Sight:
    """Tells which points the obstacles of a world hide. The ground hides nothing."""

    def __init__(self, world: World) -> None:
        self._mesh: wp.Mesh | None = None
        if world.obstacles:
            solids = Solids.of(world.obstacles)
            faces = solids.faces.flatten().int().numpy()
            self._mesh = wp.Mesh(array(solids.vertices.numpy(), wp.vec3), array(faces, int))

    def hidden(self, eye: Tensor, points: Tensor) -> Tensor:
        """Returns whether an obstacle lies between ``eye [..., 3]`` and ``points [..., 3]`` (m): bool ``[...]``."""
        eye, points = torch.broadcast_tensors(eye, points)
        hidden = torch.zeros(points.shape[:-1], dtype=torch.uint8)
        if self._mesh is not None and hidden.numel():
            ends = [array(part.reshape(-1, 3).numpy(), wp.vec3) for part in (eye, points)]
            flags = wp.from_torch(hidden.view(-1))
            launch(kernels.find_hidden, flags.shape, [self._mesh.id, *ends, FREE_FRACTION, flags])
        return hidden.bool()


@dataclass(frozen=True)
class Camera:
    """Camera at ``eye`` that looks at ``target`` (m), with a direction ``up``: float64 ``[3]`` each."""

    eye: Tensor
    target: Tensor
    up: Tensor
    sight: Sight

    @classmethod
    def on(cls, position: Tensor, orientation: Tensor, sight: Sight, view: View) -> Camera:
        """Creates the camera behind (``"chase"``) or above (``"top"``) a rover with a quaternion (x, y, z, w).

        The chase camera moves up when an obstacle hides a part of the rover, and nearer, such as below a low ceiling.
        If that does not help, it sees as much as it can. Raises ``ValueError`` for an unknown view.
        """
        position, up = position.double(), torch.tensor((0.0, 0.0, 1.0), dtype=torch.float64)
        if view == "top":
            north = torch.tensor((0.0, 1.0, 0.0), dtype=torch.float64)
            return cls(position + _TOP_HEIGHT * up, position, north, sight)
        if view != "chase":
            raise ValueError(f"unknown view {view!r}; use 'chase' or 'top'")
        yaw = quaternion_to_euler(orientation)[2].item()
        ahead = torch.tensor((math.cos(yaw), math.sin(yaw), 0.0), dtype=torch.float64)
        toward = _ELEVATIONS.sin()[:, None] * up - _ELEVATIONS.cos()[:, None] * ahead
        eyes = position + (_CHASE_DISTANCES[:, None, None] * toward).flatten(0, 1)
        body = position + _BODY_POINTS @ torch.stack((ahead, torch.linalg.cross(up, ahead), up))
        # The first of those that hide least.
        best = int(sight.hidden(eyes[:, None], body).sum(-1).argmin())
        return cls(eyes[best], position + 0.8 * ahead + 0.15 * up, up, sight)

    @property
    def axes(self) -> Tensor:
        """Directions that point right and down in the image, and forward: unit vectors ``[3, 3]``."""
        forward = torch.nn.functional.normalize(self.target - self.eye, dim=0)
        right = torch.nn.functional.normalize(torch.linalg.cross(forward, self.up), dim=0)
        return torch.stack((right, torch.linalg.cross(forward, right), forward))

    def see(self, points: Tensor, width: int, height: int) -> tuple[Tensor, Tensor]:
        """Projects ``points [..., 3]`` (m) into an image, and returns their pixels and whether they are visible.

        Pixels are ``[..., 2]`` (right, down), NaN behind the near plane. Obstacles hide points, the ground does not.
        """
        points = points.double()
        offset, depth = ((points - self.eye) @ self.axes.T).split((2, 1), -1)
        depth = depth.masked_fill(depth < NEAR, math.nan)
        visible = (depth.squeeze(-1) > 0) & ~self.sight.hidden(self.eye, points)
        return torch.tensor((width / 2, height / 2)) + focal_length(height) * offset / depth, visible


def focal_length(height: int) -> float:
    """Focal length of images of a height, both in pixels."""
    return height / 2 / math.tan(math.radians(FIELD_OF_VIEW / 2))


class Renderer:
    """Renderer of a robot in one world. ``sight`` tells which points the obstacles hide."""

    def __init__(self, world: World, robot: Robot) -> None:
        # Here, as it must not happen in two threads at a time.
        wp.load_module(kernels, device=DEVICE)
        self._world, self._lock = world, Lock()
        self._scenery = TracedWorld(world)
        self._shapes = TracedShapes([surfaces.robot_surface(robot), surfaces.post_surface()])
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
                forms = surfaces.forms_of(self._world, movers)
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
