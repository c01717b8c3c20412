"""``MovingGridPlanner``: the planner on a map of what has been seen, among obstacles that it sees moving.

Example:
    >>> env = make_env(world_n="maze", num_envs=4, lidar_points=128)
    >>> runner = PolicyRunner(MovingGridPlanner())
    >>> runner(env.reset()).shape
    torch.Size([4, 2])
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from rover_rl.algos.policy.grid_planner import GridPlanner
from rover_rl.algos.policy.tracker import STATE, TRACKS, MoverTracker, Tracks
from rover_rl.envs.config import LidarConfig
from rover_rl.envs.seen_map.scans import CELL, Scan
from rover_rl.envs.seen_map.seen_map import SeenMap
from rover_rl.sims.robots import Robot, get_robot
from rover_rl.sims.robots.footprint import footprint

MARGIN = 0.1  # free distance between the robot's side and what moves, m


class MovingMap(SeenMap):
    """Map of what has been seen, without what moves. Where the rover would meet that, cells are closed for one plan.

    What moves is followed by a :class:`~rover_rl.algos.policy.tracker.MoverTracker`. A cell is closed if something that
    moves at constant velocity is there within 0.75 s of the time at which the rover could be, in the coming 4 s. Ends
    of beams that belong to it do not mark the map. Where nothing moves, routes are those of the base class.
    """

    def __init__(
        self,
        rows: int,
        lidar: LidarConfig | None = None,
        robot: str | Robot = "rover_zero",
        device: torch.device | str | None = None,
        threads: int = 1,
        interval: float = 0.2,
    ) -> None:
        super().__init__(rows, lidar, robot, device, threads, interval)
        self._tracker = MoverTracker(get_robot(robot), lidar or LidarConfig(), interval)
        self._tracks = torch.zeros(rows, TRACKS * STATE, device=self._levels.device)
        self._moving: Tracks | None = None
        self._side, self._speed = footprint(get_robot(robot)).half_width + MARGIN, get_robot(robot).drive.max_speed
        self._open = torch.empty_like(self._levels)

    def _noted(self, scan: Scan, lidar: Tensor, pose: Tensor, imu: Tensor, renewed: Tensor | None) -> Scan:
        if renewed is not None:
            self._tracks = self._tracks.masked_fill(renewed[:, None], 0.0)
        self._next, self._moving = self._tracker(self._tracks, lidar, pose, imu)
        self._place = pose[:, :2] / (CELL * self._unit)
        return scan._replace(hits=scan.hits & ~self._moving.readings)

    def _closing(self, rows: Tensor, center: Tensor) -> tuple[Any, list[Any]] | None:
        from rover_rl.algos.policy.moving_kernels import close_ways

        assert self._moving is not None
        self._tracks = torch.where(rows[:, None], self._next, self._tracks)
        moving = self._moving
        radius = torch.where(moving.moves, moving.radius + self._side, -1.0)[..., None]
        ways = torch.cat((moving.position, moving.velocity, radius), -1) / (CELL * self._unit)
        inputs = [
            rows,
            center,
            self._place,
            ways.contiguous(),
            self._speed / (CELL * self._unit),
            self._levels,
            self._open,
        ]
        return close_ways, inputs


class MovingGridPlanner(GridPlanner):
    """The :class:`~rover_rl.algos.policy.grid_planner.GridPlanner` on a map of what stands and what moves.

    Attributes:
        map_class: map that a :class:`~rover_rl.algos.policy.runner.PolicyRunner` keeps for it.
    """

    map_class = MovingMap
