"""``PlainSeenMap``: the map and the route of :class:`~rover_rl.envs.seen_map.seen_map.SeenMap` for export."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from rover_rl.envs.config import LidarConfig
from rover_rl.envs.seen_map.cell_kernels import CELL, SIZE, UNSEEN
from rover_rl.envs.seen_map.plain_routes import plan
from rover_rl.envs.seen_map.plain_scans import (
    Lidar,
    levels,
    moved_window,
    packed,
    tilted,
    unpacked,
    waited,
    with_scan,
)
from rover_rl.envs.seen_map.seen_map import (
    beam_directions,
    clearance_of,
    goal_positions,
    largest_reading,
    lidar_mount,
    patience_of,
    relative_route,
)
from rover_rl.sims.robots import Robot


class PlainSeenMap(nn.Module):
    """One decision of a :class:`~rover_rl.envs.seen_map.seen_map.SeenMap` as a function of plain tensors.

    Args:
        lidar: settings of the lidar; ``None``: the defaults.
        robot: robot, or its name, for the position of the lidar.
        interval: time from one decision to the next, s.

    Attributes:
        state_size: number of entries of the state.

    Raises:
        ValueError: if the lidar is mounted too far from the robot's center.
    """

    state_size = 8 + 2 * SIZE * SIZE

    _directions: Tensor
    _mount: Tensor

    def __init__(
        self, lidar: LidarConfig | None = None, robot: str | Robot = "rover_zero", interval: float = 0.2
    ) -> None:
        super().__init__()
        lidar = lidar or LidarConfig()
        self._max_range, self._clearance = largest_reading(lidar), clearance_of(robot)
        self._patience = patience_of(interval)
        self.register_buffer("_directions", beam_directions(lidar))
        self.register_buffer("_mount", torch.tensor(lidar_mount(robot)))

    def forward(
        self, state: Tensor, lidar: Tensor, pose: Tensor, imu: Tensor, target: Tensor, bounds: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Adds a scan and plans the route.

        Args:
            state: state before, ``[N, state_size]``: the cell in the middle of the window, whether the ground is
                rough, the place around which the rover is and its number of scans there, the first corner of the route,
                and what has been seen in each cell of the window and how high it is. Zeros at the start of an episode.
            lidar: lidar readings, ``[N, P]``, m.
            pose: x, y and z, ``[N, 3]``, m.
            imu: pitch, roll and yaw, ``[N, 3]``, rad.
            target: distance (m) and relative angle (rad) of the goal, ``[N, 2]``.
            bounds: lower x and y and upper x and y of the area that the routes stay in, ``[N, 4]``, m.

        Returns:
            The route, ``[N, 5]``, as ``SeenMap`` returns it, and the next state.
        """
        before, was_rough = state[:, :2], state[:, 2:3] > 0
        cells, heights = state[:, 8:].reshape(-1, 2, SIZE, SIZE).unbind(1)
        center = (pose[:, :2] / CELL).floor()
        poses = torch.cat((pose[:, :2], imu, pose[:, 2:]), -1)
        sensor = Lidar(self._directions, self._mount, self._max_range)
        rough = was_rough | tilted(poses)
        turned = (rough != was_rough)[..., None]
        cells = torch.where(turned, 0.0, moved_window(cells, center - before))
        heights = torch.where(turned, UNSEEN, moved_window(heights, center - before, UNSEEN))
        places, waits = waited(state[:, 3:5], state[:, 5:6], poses)
        halted = waits > self._patience
        content, heights = with_scan(
            unpacked(cells), heights, center, rough, halted, state[:, 6:8], poses, lidar, sensor
        )
        level = levels(content, rough, self._clearance)
        corners, lengths = plan(level, center, goal_positions(pose, imu, target), bounds)
        route = relative_route(corners, lengths, pose, imu)
        waits = torch.where(halted, 1.0, waits)
        kept = torch.stack((packed(content), heights), 1).flatten(1)
        return route, torch.cat((center, rough.to(center.dtype), places, waits, corners[:, 0], kept), -1)
