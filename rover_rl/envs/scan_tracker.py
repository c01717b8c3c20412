"""``ScanTracker``: what the trackers of lidar scans share: where the lidars are, and where their readings point."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from rover_rl.envs.config import LidarConfig
from rover_rl.envs.seen_map.scans import reading_angles, reading_directions
from rover_rl.sims.robots import Robot
from rover_rl.sims.robots.fleet import Fleet


class ScanTracker:
    """Follows something from scan to scan.

    Args:
        robot: robot that carries the lidar, or the robots of the rows.
        lidar: settings of the lidar.
        interval: time from one scan to the next, s.
    """

    def __init__(self, robot: Robot | Fleet, lidar: LidarConfig, interval: float) -> None:
        self._range, self._dt = lidar.max_range - 1e-3, interval
        self._fleet = robot if isinstance(robot, Fleet) else None
        robots = robot.robots if isinstance(robot, Fleet) else (robot,)
        self._mounts = torch.tensor([each.lidar_position[:2] for each in robots])
        self._directions = reading_directions(lidar)
        # Of the first reading, and from one to the next, rad.
        self._angles = float(reading_angles(lidar)[0]), 2 * math.pi / lidar.points

    def _scans(self, lidar: Tensor, pose: Tensor, imu: Tensor, rows: Tensor | None, due: Tensor | None) -> list[Any]:
        """Returns the inputs of a kernel that reads scans: the first ten of ``follow`` and of ``follow_walls``."""
        device, count = lidar.device, len(lidar)
        self._mounts, self._directions = self._mounts.to(device), self._directions.to(device)
        due = torch.ones(count, dtype=torch.bool, device=device) if due is None else due.contiguous()
        scans = (value.contiguous() for value in (lidar, pose, imu))
        robots = self._robots(lidar, rows)
        return [due, *scans, self._mounts, robots, self._directions, self._angles, self._range, self._dt]

    def _robots(self, lidar: Tensor, rows: Tensor | None) -> Tensor:
        """Returns the number of each row's robot, int64 ``[N]``."""
        if self._fleet is None:
            return torch.zeros(len(lidar), dtype=torch.int64, device=lidar.device)
        return self._fleet.index if rows is None else self._fleet.index[rows]


def along_heading(pairs: Tensor, observation: TensorDictBase | Mapping[str, Tensor]) -> Tensor:
    """Returns world vectors ``[N, M, 2]`` along the axes of each rover's base frame."""
    yaw = observation["imu"][:, 2:]
    cos, sin = yaw.cos(), yaw.sin()
    x, y = pairs.unbind(-1)
    return torch.stack((cos * x + sin * y, cos * y - sin * x), -1)
