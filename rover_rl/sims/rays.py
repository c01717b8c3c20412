"""Rays to the ground and the obstacles of each row's world, the same in every simulator, and views of lidars.

Example:
    >>> caster = RayCaster(WorldTable([World("flat", Terrain.flat((20.0, 20.0)))]))
    >>> caster.cast(torch.tensor([[[0.0, 0.0, 2.0]]]), torch.tensor([[[0.0, 0.0, -1.0]]]))
    tensor([[2.]])
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from rover_rl.native.warp import launch_rows, stream_of, wp
from rover_rl.robots.fleet import Fleet
from rover_rl.sims.base import Scanner
from rover_rl.sims.rover_state import RoverState
from rover_rl.sims.scenes.ray_kernels import aim_rays, cast_rays
from rover_rl.sims.scenes.table import SceneTable
from rover_rl.worlds.table import WorldTable

FAR = 1.0e4
"""Largest length of rays, m."""
ROWS_PER_THREAD = 8
"""Least number of rows for which a CPU thread pays."""
_TOLERANCE = 1e-6
"""Tolerance of angles at the borders of a view, rad."""


class RayCaster:
    """Casts rays in the worlds of the rows of a batch, without rovers. A scene is built when a row first needs it."""

    def __init__(self, worlds: WorldTable) -> None:
        self._worlds, self._entered = worlds, worlds.follow()
        self._device = worlds.slots.device
        self._scenes = SceneTable.of_solids(worlds.capacity, 0.0, wp.device_from_torch(self._device))

    def scenes(self) -> tuple[Any, Tensor]:
        """Returns the scenes of the worlds as kernels read them, and the number of that of each row, int64 ``[N]``."""
        with wp.ScopedStream(stream_of(self._device)):
            for slot, world in self._entered().items():
                self._scenes[slot] = world
        return self._scenes.scenes, self._worlds.slots

    def cast(self, origins: Tensor, directions: Tensor, farthest: float = math.inf) -> Tensor:
        """Returns the distance along each ray to the ground or an obstacle, float32 ``[N, K]``, m.

        ``inf`` means no return, also beyond the edge of the terrain, and 0 a ray that starts inside of a solid.

        Args:
            origins: starts of the rays in the world frame, ``[N, K, 3]``, m.
            directions: directions in the world frame, of any length but 0, ``[N, K, 3]``.
            farthest: length of the rays, m. Short ones take less time.
        """
        scenes, slots = self.scenes()
        with wp.ScopedStream(stream_of(self._device)):
            ranges = torch.empty(origins.shape[:2], device=self._device)
            rays = [wp.from_torch(part.float().contiguous(), dtype=wp.vec3) for part in (origins, directions)]
            inputs = [scenes, wp.from_torch(slots), *rays, min(farthest, FAR), wp.from_torch(ranges)]
            launch_rows(cast_rays, ranges.shape, inputs, self._device, ROWS_PER_THREAD)
        return ranges


def aimed_rays(rover: RoverState, mount: Sequence[float], directions: Tensor) -> tuple[Tensor, Tensor]:
    """Returns origins and directions of rays from rovers in the world frame, float32 ``[N, K, 3]`` each.

    ``mount`` (m) and ``directions [K, 3]`` are in the frame of the rover.
    """
    device = rover.position.device
    origins = torch.empty(len(rover.position), *directions.shape, device=device)
    rays = torch.empty_like(origins)
    with wp.ScopedStream(stream_of(device)):
        position, orientation, local = (
            wp.from_torch(part.float().contiguous(), dtype=dtype)
            for part, dtype in ((rover.position, wp.vec3), (rover.orientation, wp.quat), (directions, wp.vec3))
        )
        world = [wp.from_torch(part, dtype=wp.vec3) for part in (origins, rays)]
        inputs = [position, orientation, wp.vec3(*mount), local, *world]
        wp.launch(aim_rays, rays.shape[:2], inputs, device=wp.device_from_torch(device))
    return origins, rays


def seen(angles: Tensor, view: float | Tensor) -> Tensor:
    """Whether directions (rad) are in a view that is centered on straight ahead, bool.

    ``view`` is the total angle of the view, or of several views, with which ``angles`` are broadcast, rad.
    """
    return (torch.remainder(angles + math.pi, 2 * math.pi) - math.pi).abs() <= view / 2 + _TOLERANCE


class ViewScanner:
    """Lidar that sees less than a full turn: beams outside of the view of a row's robot have no return."""

    def __init__(self, scanner: Scanner, fleet: Fleet) -> None:
        self.angles = scanner.angles
        self._scanner, self._fleet = scanner, fleet
        # Beams outside of the view of each robot's lidar, [K, beams].
        self._hidden = torch.stack([~seen(scanner.angles, robot.lidar_view) for robot in fleet.robots])

    def scan(self, rows: Tensor | None = None) -> Tensor:
        hidden = self._hidden
        if len(hidden) > 1:
            hidden = hidden[self._fleet.index.to(hidden.device)]
        return self._scanner.scan(rows).masked_fill(hidden, math.inf)


def in_view(scanner: Scanner, fleet: Fleet) -> Scanner:
    """Returns a lidar with the views of the robots, which is the scanner itself if they see a full turn."""
    least = min(robot.lidar_view for robot in fleet.robots)
    return scanner if least >= 2 * math.pi - _TOLERANCE else ViewScanner(scanner, fleet)
