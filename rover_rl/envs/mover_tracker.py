"""``MoverTracker``: positions, velocities and sizes of what moves, from the lidar scans of a batch of rovers.

Readings of neighboring directions that are near each other belong to one cluster. Clusters of up to 1.6 m are compared
from scan to scan: a Kalman filter with constant velocity follows each of up to 32 tracks, and a track and a cluster
belong together if each is the nearest of the other. Two legs are one person.

- An object hidden in part is as large as its track, and its center follows from the edge that is seen.
- One that is hidden goes on at its velocity for up to 1.8 s, as long as its place is known within 0.35 m. One that
  should be seen but is not ends after 0.3 s.
- A track moves once its way is longer than its errors. Where one of its edges is mostly hidden, as that of a wall
  behind people, beams must also pass where it was.

It is a Warp kernel with a thread for each row. The tracks are one tensor, which a policy keeps as its memory.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import torch
from tensordict import TensorDictBase
from torch import Tensor

from rover_rl.envs.scan_tracker import ScanTracker, along_heading
from rover_rl.envs.sensors.lidar_mask import known_readings
from rover_rl.envs.sensors.scan_pose import taken_at

TRACKS = 32
"""Number of tracks of a row."""
STATE = 17
"""Numbers of a track: see :mod:`~rover_rl.envs.mover_tracker_kernels`. All are 0 without a track."""


class Tracks(NamedTuple):
    """What moves around each rover.

    Attributes:
        position: centers in the world, ``[N, TRACKS, 2]``, m.
        velocity: velocities in the world, ``[N, TRACKS, 2]``, m/s.
        radius: radii, ``[N, TRACKS]``, m.
        moves: which tracks exist and move, bool ``[N, TRACKS]``.
        readings: which lidar readings belong to one that moves, bool ``[N, points]``.
    """

    position: Tensor
    velocity: Tensor
    radius: Tensor
    moves: Tensor
    readings: Tensor


class MoverTracker(ScanTracker[Tracks]):
    """Follows what moves, from scan to scan: see the module ``mover_tracker``."""

    tracks = TRACKS

    def _follow(self, scans: Any, before: Tensor, after: Tensor) -> Tracks:
        from rover_rl.envs.mover_tracker_kernels import CLUSTER, follow
        from rover_rl.native.warp import launch_options, wp

        device, (count, points) = after.device, scans.ranges.shape
        moves = torch.zeros(count, TRACKS, dtype=torch.bool, device=device)
        readings = torch.zeros(count, points, dtype=torch.bool, device=device)
        clusters = torch.empty(count, points, CLUSTER, device=device)
        seen = torch.empty(count, 2, TRACKS, dtype=torch.int32, device=device)
        wp.launch(follow, count, [scans, before, clusters, seen, after, moves, readings], **launch_options(device))
        position, velocity, radius = after[..., 1:6].split((2, 2, 1), -1)
        return Tracks(position, velocity, radius[..., 0], moves, readings)


def tracked(tracker: MoverTracker, tensordict: TensorDictBase) -> tuple[Tensor, Tracks]:
    """Returns the next state of a policy that remembers ``tracks``, and what moves."""
    lidar = known_readings(tensordict)
    pose, imu = taken_at(tensordict) or (tensordict["pose"], tensordict["imu"])
    state = tensordict.get("tracks", None)
    if state is None:
        state = lidar.new_zeros(len(lidar), TRACKS * STATE)
    is_init = tensordict.get("is_init", None)
    if is_init is not None:
        state = state.masked_fill(is_init.reshape(-1, 1), 0.0)
    return tracker(state, lidar, pose, imu)


def in_base_frame(tracks: Tracks, tensordict: TensorDictBase | Mapping[str, Tensor]) -> Tracks:
    """Returns tracks relative to each rover's position and heading. Velocities stay those over ground."""
    position = along_heading(tracks.position - tensordict["pose"][:, None, :2], tensordict)
    return tracks._replace(position=position, velocity=along_heading(tracks.velocity, tensordict))
