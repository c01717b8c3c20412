"""Rays and lidars that meet movers, the same in every simulator."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from rover_rl.robots import Robot
from rover_rl.robots.fleet import Fleet
from rover_rl.sims.base import Scanner, Simulator
from rover_rl.sims.movers.field import MoverField
from rover_rl.sims.movers.parts import Parts

if TYPE_CHECKING:
    from rover_rl.sims.movers.kernels import PartArrays


def cast_at_movers(parts: Parts, origins: Tensor, directions: Tensor, ranges: Tensor) -> Tensor:
    """Returns the ranges of rays, where they meet a mover the distance to it, float32 ``[N, K]``, m.

    Args:
        parts: solids of the movers.
        origins: starts of the rays in the world frame, ``[N, K, 3]``, m.
        directions: directions in the world frame, of any length but 0, ``[N, K, 3]``.
        ranges: distances to what does not move, ``[N, K]``, m.
    """
    # Importing NVIDIA Warp takes half a second.
    from rover_rl.native.warp import stream_of, wp
    from rover_rl.sims.movers.kernels import cast_at_parts

    ranges = ranges.clone()
    with wp.ScopedStream(stream_of(ranges.device)):
        rays = [wp.from_torch(part.float().contiguous(), dtype=wp.vec3) for part in (origins, directions)]
        inputs = [part_arrays(parts), *rays, wp.from_torch(ranges)]
        wp.launch(cast_at_parts, ranges.shape, inputs, device=wp.device_from_torch(ranges.device))
    return ranges


def part_arrays(parts: Parts) -> PartArrays:
    """Returns the parts as kernels read them, in the same memory."""
    from rover_rl.native.warp import wp
    from rover_rl.sims.movers.kernels import PartArrays

    arrays = PartArrays()
    arrays.kind = wp.from_torch(parts.kind)
    arrays.half = wp.from_torch(parts.half, dtype=wp.vec3)
    arrays.position = wp.from_torch(parts.position, dtype=wp.vec3)
    arrays.orientation = wp.from_torch(parts.orientation, dtype=wp.quat)
    return arrays


class MoverScanner:
    """Lidar that sees movers, besides what another scanner sees: see :class:`~rover_rl.sims.base.Scanner`.

    Args:
        scanner: scanner of what does not move.
        movers: movers of the rows.
        simulator: simulator of the rovers.
        robot: robot that carries the lidar, or the robots of the rows.
    """

    def __init__(self, scanner: Scanner, movers: MoverField, simulator: Simulator, robot: Robot | Fleet) -> None:
        self.angles = scanner.angles
        self._scanner, self._movers, self._simulator = scanner, movers, simulator
        self._fleet = Fleet.of(robot, simulator.num_envs, simulator.device)
        # Position of the lidar, and its range.
        self._mounts = self._fleet.table(lambda robot: [*robot.lidar_position, robot.lidar_range])
        angles = scanner.angles.double()
        self._beams = torch.stack((angles.cos(), angles.sin()), -1).float()
        self._every = torch.ones(simulator.num_envs, dtype=torch.bool, device=simulator.device)
        self._ranges: Tensor | None = None

    def scan(self, rows: Tensor | None = None) -> Tensor:
        """Scans: see :meth:`~rover_rl.sims.base.Scanner.scan`."""
        ranges = self._scanner.scan(rows)
        if self._movers.parts is None:
            return ranges
        scanning = self._every if rows is None else rows
        self._shorten(self._movers.parts, ranges, scanning)
        # The other scanner knows no movers, also in the rows that keep their last scan.
        last = ranges if self._ranges is None else self._ranges
        self._ranges = ranges if rows is None else torch.where(rows[:, None], ranges, last)
        return self._ranges

    def _shorten(self, parts: Parts, ranges: Tensor, rows: Tensor) -> None:
        """Shortens the beams that meet a mover, in place."""
        from rover_rl.native.warp import stream_of, wp
        from rover_rl.sims.movers.kernels import scan_parts

        state = self._simulator.state()
        poses = torch.cat((state.position, state.orientation), -1).contiguous()
        with wp.ScopedStream(stream_of(ranges.device)):
            inputs = [
                part_arrays(parts),
                wp.from_torch(poses),
                wp.from_torch(self._mounts[self._fleet.index.to(ranges.device)], dtype=wp.vec4),
                wp.from_torch(self._beams, dtype=wp.vec2),
                wp.from_torch(rows.contiguous()),
                wp.from_torch(ranges),
            ]
            wp.launch(scan_parts, len(ranges), inputs, device=wp.device_from_torch(ranges.device))
