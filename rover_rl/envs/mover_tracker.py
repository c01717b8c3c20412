"""``MoverTracker``: positions, velocities and sizes of what moves, from the lidar scans of a batch of rovers."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import torch
from tensordict import TensorDictBase
from torch import Tensor

from rover_rl.envs.config import LidarConfig
from rover_rl.envs.seen_map.scans import along_heading, reading_angles, reading_directions
from rover_rl.envs.sensors.standard import known_readings, taken_at
from rover_rl.robots import Robot
from rover_rl.robots.fleet import Fleet

TRACKS = 32
"""Number of tracks of a row."""
STATE = 17
"""Numbers of a track: see :mod:`~rover_rl.envs.mover_tracker_kernels`. All are 0 without a track."""


class Tracks(NamedTuple):
    """What moves around each rover.

    Centers (m), velocities (m/s) and radii (m) in the world, ``[N, TRACKS, ...]``, and which tracks exist and move. Of
    the lidar's ``readings``, bool ``[N, points]``: which belong to one that moves.
    """

    position: Tensor
    velocity: Tensor
    radius: Tensor
    moves: Tensor
    readings: Tensor

    def in_base_frame(self, observation: TensorDictBase | Mapping[str, Tensor]) -> Tracks:
        """Returns the tracks relative to each rover's position and heading. Velocities stay those over ground."""
        position = along_heading(self.position - observation["pose"][:, None, :2], observation["imu"])
        return self._replace(position=position, velocity=along_heading(self.velocity, observation["imu"]))


class MoverTracker:
    """Follows what moves, from scan to scan.

    Readings of neighboring directions that are near each other belong to one cluster. Clusters of up to 1.6 m are
    compared from scan to scan: a Kalman filter with constant velocity follows each of up to 32 tracks, and a track and
    a cluster belong together if each is the nearest of the other. Two legs are one person.

    - An object hidden in part is as large as its track, and its center follows from the edge that is seen.
    - One that is hidden goes on at its velocity for up to 1.8 s, as long as its place is known within 0.5 m. One that
      should be seen but is not ends after 0.3 s.
    - A track moves once its way is longer than its errors. Where one of its edges is mostly hidden, as that of a wall
      behind people, beams must also pass where it was.

    It is a Warp kernel with a thread for each row. The tracks are one tensor, which a policy keeps as its memory.
    ``robot``, or each robot of a fleet in its row, carries the ``lidar``. Scans are ``interval`` (s) apart.
    """

    def __init__(self, robot: Robot | Fleet, lidar: LidarConfig, interval: float) -> None:
        self._range, self._dt = lidar.max_range - 1e-3, interval
        self._fleet = robot if isinstance(robot, Fleet) else None
        robots = robot.robots if isinstance(robot, Fleet) else (robot,)
        self._mounts = torch.tensor([each.lidar_position[:2] for each in robots])
        self._directions = reading_directions(lidar)
        # Of the first reading, and from one to the next, rad.
        self._angles = float(reading_angles(lidar)[0]), 2 * math.pi / lidar.points

    def __call__(self, state: Tensor, observation: TensorDictBase | Mapping[str, Tensor]) -> tuple[Tensor, Tracks]:
        """Adds a scan, and returns the next state and what moves: see :meth:`follow`."""
        after = state.clone(memory_format=torch.contiguous_format)
        return after, self.follow(after, observation)

    def follow(
        self, state: Tensor, observation: TensorDictBase | Mapping[str, Tensor], due: Tensor | None = None
    ) -> Tracks:
        """Adds a scan to the ``state``, and returns what moves: nothing in rows that are not due.

        ``state`` are the tracks, which change, ``[N, TRACKS * STATE]``; zeros without any. The ``observation``,
        ``[N]``, has ``lidar``, ``pose`` and ``imu``, ``scan_pose`` if scans can be late, and ``lidar_mask`` if beams
        can be hidden. ``due`` says which of the scans are added, bool ``[N]``; ``None``: all.
        """
        # Importing NVIDIA Warp takes half a second.
        from rover_rl.envs.mover_tracker_kernels import CLUSTER, follow
        from rover_rl.native.warp import BLOCK_SIZE, launch_rows

        scans, (count, points), device = self._scans(observation, due), observation["lidar"].shape, state.device
        tracks = state.view(count, TRACKS, STATE)
        moves = torch.zeros(count, TRACKS, dtype=torch.bool, device=device)
        readings = torch.zeros(count, points, dtype=torch.bool, device=device)
        clusters = torch.empty(count, points, CLUSTER, device=device)
        seen = torch.empty(count, 2, TRACKS, dtype=torch.int32, device=device)
        launch_rows(follow, (count,), [scans, clusters, seen, tracks, moves, readings], device, block_dim=BLOCK_SIZE)
        position, velocity, radius = tracks[..., 1:6].split((2, 2, 1), -1)
        return Tracks(position, velocity, radius[..., 0], moves, readings)

    def remembered(self, tensordict: TensorDictBase) -> tuple[Tensor, Tracks]:
        """Adds the scan of a policy that remembers ``tracks``, and returns its next state and what moves."""
        state, is_init = tensordict.get("tracks", None), tensordict.get("is_init", None)
        if state is None:
            state = tensordict["lidar"].new_zeros(len(tensordict), TRACKS * STATE)
        return self(state if is_init is None else state.masked_fill(is_init.reshape(-1, 1), 0.0), tensordict)

    def _scans(self, observation: TensorDictBase | Mapping[str, Tensor], due: Tensor | None) -> Any:
        from rover_rl.envs.mover_tracker_kernels import Scans
        from rover_rl.native.warp import wp

        lidar, (pose, imu) = known_readings(observation), taken_at(observation)
        device = lidar.device
        self._mounts, self._directions = self._mounts.to(device), self._directions.to(device)
        due = torch.ones(len(lidar), dtype=torch.bool, device=device) if due is None else due.contiguous()
        robots = self._fleet.index if self._fleet else torch.zeros(len(lidar), dtype=torch.int64, device=device)
        scans = Scans()
        scans.due, scans.robots = wp.from_torch(due), wp.from_torch(robots)
        scans.ranges, scans.poses, scans.imus = (wp.from_torch(value.contiguous()) for value in (lidar, pose, imu))
        scans.mounts, scans.beams = (wp.from_torch(value, dtype=wp.vec2) for value in (self._mounts, self._directions))
        scans.angles, scans.most, scans.dt = wp.vec2(*self._angles), self._range, self._dt
        scans.points = wp.from_torch(torch.empty(*lidar.shape, 2, device=device), dtype=wp.vec2)
        scans.labels = wp.from_torch(torch.empty(lidar.shape, dtype=torch.int32, device=device))
        return scans
