"""Rays to the ground and the obstacles of each row's world, the same in every simulator, and a lidar that casts them.

Example:
    >>> caster = RayCaster(WorldTable([World("flat", Terrain.flat((20.0, 20.0)))]))
    >>> caster.cast(torch.tensor([[[0.0, 0.0, 2.0]]]), torch.tensor([[[0.0, 0.0, -1.0]]]))
    tensor([[2.]])
"""

from __future__ import annotations

import math
from weakref import WeakKeyDictionary

import numpy as np
import torch
from torch import Tensor

from rover_rl.sims.base import Simulator, beam_angles
from rover_rl.sims.native.warp import wp
from rover_rl.sims.ray_kernels import cast_rays
from rover_rl.sims.robots import Robot
from rover_rl.sims.rotations import rotate
from rover_rl.sims.worlds import Terrain, World
from rover_rl.sims.worlds.obstacles import groups_of
from rover_rl.sims.worlds.table import WorldTable


class RayCaster:
    """Casts rays in the worlds of the rows of a batch.

    A world is one triangle mesh, built when a row first needs it. The range of a ray depends on its row's world alone.
    Rovers are not in the meshes.

    Args:
        worlds: world of each row.
    """

    def __init__(self, worlds: WorldTable) -> None:
        self._worlds, self._entered = worlds, worlds.follow()
        self._device = worlds.slots.device
        # Rovers may come back to a world that another one has replaced.
        self._meshes: WeakKeyDictionary[World, wp.Mesh] = WeakKeyDictionary()
        # Mesh of each slot.
        self._ids = torch.zeros(worlds.capacity, dtype=torch.int64, device=self._device)

    def cast(self, origins: Tensor, directions: Tensor) -> Tensor:
        """Returns the distance along each ray to the ground or an obstacle, float32 ``[N, K]``, m.

        ``inf`` means no return, also beyond the edge of the terrain, and 0 a ray that starts inside of a solid.

        Args:
            origins: starts of the rays in the world frame, ``[N, K, 3]``, m.
            directions: directions in the world frame, of any length but 0, ``[N, K, 3]``.
        """
        # Torch's current stream orders the kernel and tensor operations.
        stream = wp.stream_from_torch(self._device) if self._device.type == "cuda" else None
        with wp.ScopedStream(stream):
            for slot, world in self._entered().items():
                self._ids[slot] = self._mesh(world).id
            ranges = torch.full(origins.shape[:2], math.inf, device=self._device)
            rays = (wp.from_torch(part.float().contiguous(), dtype=wp.vec3) for part in (origins, directions))
            inputs = [wp.from_torch(self._ids, dtype=wp.uint64), wp.from_torch(self._worlds.slots), *rays]
            inputs.append(wp.from_torch(ranges))
            wp.launch(cast_rays, ranges.shape, inputs, device=wp.device_from_torch(self._device))
        return ranges

    def _mesh(self, world: World) -> wp.Mesh:
        if world not in self._meshes:
            vertices, faces = world_mesh(world)
            device = wp.device_from_torch(self._device)
            points = wp.array(vertices.astype(np.float32), dtype=wp.vec3, device=device)
            self._meshes[world] = wp.Mesh(points, wp.array(faces.flatten().astype(np.int32), dtype=int, device=device))
        return self._meshes[world]


class RayScanner:
    """Lidar of a simulator that has none of its own: see :class:`~rover_rl.sims.base.Scanner`.

    Args:
        simulator: simulator of the rovers.
        worlds: world of each row.
        robot: robot that carries the lidar.
        beams: number of beams, equally spaced over a full turn.
    """

    def __init__(self, simulator: Simulator, worlds: WorldTable, robot: Robot, beams: int) -> None:
        angles = beam_angles(beams)
        self.angles = angles.float().to(simulator.device)
        self._simulator, self._caster, self._range = simulator, RayCaster(worlds), robot.lidar_range
        self._mount = torch.tensor(robot.lidar_position, device=simulator.device)
        directions = torch.stack((angles.cos(), angles.sin(), torch.zeros_like(angles)), -1)
        self._directions = directions.float().to(simulator.device)
        self._ranges = torch.full((simulator.num_envs, beams), math.inf, device=simulator.device)

    def scan(self, rows: Tensor | None = None) -> Tensor:
        """Scans: see :meth:`~rover_rl.sims.base.Scanner.scan`."""
        state = self._simulator.state()
        position, orientation = state.position[:, None], state.orientation[:, None]
        rays = rotate(orientation, self._directions)
        origins = position + rotate(orientation, self._mount)
        ranges = self._caster.cast(origins.expand_as(rays), rays)
        ranges = ranges.masked_fill(ranges >= self._range, math.inf)
        self._ranges = ranges if rows is None else torch.where(rows[:, None], ranges, self._ranges)
        return self._ranges


def world_mesh(world: World) -> tuple[np.ndarray, np.ndarray]:
    """Returns the triangles of the ground and of all obstacles of a world.

    Returns:
        Vertices, float64 ``[V, 3]``, m, and triangles as indices of vertices, counter-clockwise from outside, int64
        ``[F, 3]``.
    """
    ground = [part.numpy() for part in _ground(world.terrain).mesh()]
    vertices, faces, count = [ground[0]], [ground[1]], len(ground[0])
    for solids in groups_of(world.obstacles):
        corners = solids.vertices.shape[1]
        starts = count + corners * np.arange(len(solids))
        vertices.append(solids.vertices.numpy().reshape(-1, 3))
        faces.append((starts[:, None, None] + solids.faces.numpy()).reshape(-1, 3))
        count += corners * len(solids)
    return np.concatenate(vertices), np.concatenate(faces)


def _ground(terrain: Terrain) -> Terrain:
    """Returns the terrain, and a flat one with as few cells as possible."""
    if not terrain.is_flat:
        return terrain
    rows, columns = ((count - 1) for count in terrain.heights.shape)
    cells = math.gcd(rows, columns)
    heights = terrain.heights[:1, :1].expand(rows // cells + 1, columns // cells + 1)
    return Terrain(heights, terrain.cell * cells, terrain.origin)
