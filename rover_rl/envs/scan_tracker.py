"""``ScanTracker``: what the trackers of lidar scans share."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any, ClassVar, Generic, TypeVar

import torch
from tensordict import TensorDictBase
from torch import Tensor

from rover_rl.envs.config import LidarConfig
from rover_rl.envs.seen_map.scans import reading_angles, reading_directions
from rover_rl.robots import Robot
from rover_rl.robots.fleet import Fleet

Found = TypeVar("Found")


class ScanTracker(ABC, Generic[Found]):
    """Follows something from scan to scan.

    Args:
        robot: robot that carries the lidar, or the robots of the rows.
        lidar: settings of the lidar.
        interval: time from one scan to the next, s.
    """

    tracks: ClassVar[int]
    """Number of tracks of a row."""

    def __init__(self, robot: Robot | Fleet, lidar: LidarConfig, interval: float) -> None:
        self._range, self._dt = lidar.max_range - 1e-3, interval
        self._fleet = robot if isinstance(robot, Fleet) else None
        robots = robot.robots if isinstance(robot, Fleet) else (robot,)
        self._mounts = torch.tensor([each.lidar_position[:2] for each in robots])
        self._directions = reading_directions(lidar)
        # Of the first reading, and from one to the next, rad.
        self._angles = float(reading_angles(lidar)[0]), 2 * math.pi / lidar.points

    def __call__(
        self,
        state: Tensor,
        lidar: Tensor,
        pose: Tensor,
        imu: Tensor,
        rows: Tensor | None = None,
        due: Tensor | None = None,
    ) -> tuple[Tensor, Found]:
        """Adds a scan.

        Args:
            state: tracks before, ``[N, tracks * numbers of a track]``; zeros without any.
            lidar: lidar readings, ``[N, points]``, m; negative where no beam covers one, so that it is unknown.
            pose: x, y and z of the rovers, ``[N, 3]``, m.
            imu: pitch, roll and yaw of the rovers, ``[N, 3]``, rad.
            rows: numbers of the rows among those of different robots; ``None``: all of them.
            due: which of the scans are added, bool ``[N]``; ``None``: all.

        Returns:
            The next state, and what moves: nothing in rows that are not due.
        """
        before, after = state.contiguous(), torch.empty_like(state)
        scans = self._scans(lidar, pose, imu, rows, due)
        return after, self._follow(scans, *(each.view(len(each), self.tracks, -1) for each in (before, after)))

    @abstractmethod
    def _follow(self, scans: Any, before: Tensor, after: Tensor) -> Found:
        """Adds scans to tracks ``[N, tracks, numbers]`` and returns what moves. The next tracks go to ``after``."""

    def _scans(self, lidar: Tensor, pose: Tensor, imu: Tensor, rows: Tensor | None, due: Tensor | None) -> Any:
        """Returns the scans as the kernels read them."""
        # Importing NVIDIA Warp takes half a second.
        from rover_rl.envs.scan_tracker_kernels import Scans
        from rover_rl.native.warp import wp

        device = lidar.device
        self._mounts, self._directions = self._mounts.to(device), self._directions.to(device)
        scans = Scans()
        due = torch.ones(len(lidar), dtype=torch.bool, device=device) if due is None else due.contiguous()
        scans.due, scans.robots = wp.from_torch(due), wp.from_torch(self._robots(lidar, rows))
        scans.ranges, scans.poses, scans.imus = (wp.from_torch(value.contiguous()) for value in (lidar, pose, imu))
        scans.mounts, scans.beams = (wp.from_torch(value, dtype=wp.vec2) for value in (self._mounts, self._directions))
        scans.angles, scans.most, scans.dt = wp.vec2(*self._angles), self._range, self._dt
        scans.points = wp.from_torch(torch.empty(*lidar.shape, 2, device=device), dtype=wp.vec2)
        scans.labels = wp.from_torch(torch.empty(lidar.shape, dtype=torch.int32, device=device))
        return scans

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


def in_world(pairs: Tensor, imu: Tensor) -> Tensor:
    """Returns vectors of each rover's base frame ``[N, M, 2]`` along the axes of the world."""
    cos, sin = imu[:, 2:].cos(), imu[:, 2:].sin()
    x, y = pairs.unbind(-1)
    return torch.stack((cos * x - sin * y, sin * x + cos * y), -1)
