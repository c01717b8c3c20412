"""What rays are traced against: meshes of shapes, the scenery of a world, and bodies with their poses."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from torch import Tensor

from rover_rl.native.warp import wp
from rover_rl.sims.rendering import kernels
from rover_rl.sims.rendering.surfaces import Form, Surface, ground_surface, obstacles_surface, part_surface
from rover_rl.worlds import World

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
        ground, obstacles = ground_surface(world.terrain), obstacles_surface(world)
        surface = ground if obstacles is None else Surface.join([ground, obstacles])
        super().__init__(surface, device, len(ground.faces))
        heights = world.terrain.heights
        self.scenery = kernels.Scenery()
        self.scenery.shape = self.shape
        self.scenery.level = torch.cat((heights[0], heights[-1], heights[:, 0], heights[:, -1])).mean().item()


class TracedShapes:
    """Shapes of bodies on a device, by number: those given, and those of parts of movers, made when first asked for."""

    def __init__(self, surfaces: Sequence[Surface], device: Any = DEVICE) -> None:
        self._device, self._numbers = device, dict[Form, int]()
        self._shapes = [TracedShape(surface, device) for surface in surfaces]
        self._array: wp.array | None = None

    def number(self, form: Form) -> int:
        """Returns the number of the shape of parts of a form."""
        if form not in self._numbers:
            self._numbers[form] = len(self._shapes)
            self._shapes.append(TracedShape(part_surface(form), self._device))
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
