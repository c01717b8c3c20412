"""``MoverScanner``: the lidar sees movers, in every simulator alike."""

from __future__ import annotations

import torch
from torch import Tensor

from rover_rl.robots import Robot
from rover_rl.robots.fleet import Fleet
from rover_rl.sims.base import Scanner, Simulator
from rover_rl.sims.movers.field import MoverField


class MoverScanner:
    """Lidar that sees movers, besides what another scanner sees, of the robot or the robots of the rows."""

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
        ranges = self._scanner.scan(rows)
        if self._movers.parts is None:
            return ranges
        # Importing NVIDIA Warp takes half a second.
        from rover_rl.worlds.movers.part_kernels import scan_movers

        state, scanning = self._simulator.state(), self._every if rows is None else rows
        poses = torch.cat((state.position, state.orientation), -1)
        mounts = self._mounts[self._fleet.index.to(ranges.device)]
        scan_movers(self._movers.parts, poses, mounts, self._beams, scanning, ranges)
        # The other scanner knows no movers, also in the rows that keep their last scan.
        last = ranges if self._ranges is None else self._ranges
        self._ranges = ranges if rows is None else torch.where(rows[:, None], ranges, last)
        return self._ranges
