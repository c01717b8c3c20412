"""``WallTracker``: long things that move broadside, such as gates, from the lidar scans of a batch of rovers.

What :class:`~rover_rl.envs.mover_tracker.MoverTracker` leaves out as too wide is cut into straight parts. A Kalman
filter with constant velocity follows the distance of each along its normal, and its ends are remembered.

- A wall may move once its way along the normal is longer than its errors. Along itself, it is taken to rest.
- One that is hidden goes on for a second. One whose place beams pass through ends at once.

It is a Warp kernel with a thread for each row. The tracks are one tensor.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import torch
from tensordict import TensorDictBase
from torch import Tensor

from rover_rl.envs.scan_tracker import ScanTracker, along_heading

TRACKS = 12
"""Number of tracks of a row. Walls that rest have some, too."""
STATE = 20
"""Numbers of a track: see :mod:`~rover_rl.envs.wall_tracker_kernels`. All are 0 without a track."""


class Walls(NamedTuple):
    """Long things around each rover.

    Attributes:
        position: middles of what has been seen of them, in the world, ``[N, TRACKS, 2]``, m.
        along: directions along them, ``[N, TRACKS, 2]``, of length 1.
        half: half of their lengths, ``[N, TRACKS]``, m.
        velocity: velocities in the world, along their normals, ``[N, TRACKS, 2]``, m/s.
        moves: which tracks exist and move, bool ``[N, TRACKS]``.
    """

    position: Tensor
    along: Tensor
    half: Tensor
    velocity: Tensor
    moves: Tensor


class WallTracker(ScanTracker[Walls]):
    """Follows long things that move broadside, from scan to scan: see the module ``wall_tracker``."""

    tracks = TRACKS

    def _follow(self, scans: Any, before: Tensor, after: Tensor) -> Walls:
        from rover_rl.envs.wall_tracker_kernels import PART, follow_walls
        from rover_rl.native.warp import launch_options, wp

        device, (count, points) = after.device, scans.ranges.shape
        moves = torch.zeros(count, TRACKS, dtype=torch.bool, device=device)
        parts = torch.empty(count, points, PART, device=device)
        seen = torch.empty(count, TRACKS, dtype=torch.int32, device=device)
        wp.launch(follow_walls, count, [scans, before, parts, seen, after, moves], **launch_options(device))
        return _walls(after, moves)


def _walls(tracks: Tensor, moves: Tensor) -> Walls:
    """Returns the walls of tracks ``[N, TRACKS, STATE]``."""
    point, along, low, high, speed = tracks[..., 1:8].split((2, 2, 1, 1, 1), -1)
    x, y = along.unbind(-1)
    velocity = speed * torch.stack((-y, x), -1)
    return Walls(point + (low + high) / 2 * along, along, (high - low)[..., 0] / 2, velocity, moves)


def walls_in_base_frame(walls: Walls, observation: TensorDictBase | Mapping[str, Tensor]) -> Walls:
    """Returns walls relative to each rover's position and heading. Velocities stay those over ground."""
    position = along_heading(walls.position - observation["pose"][:, None, :2], observation)
    along, velocity = (along_heading(pairs, observation) for pairs in (walls.along, walls.velocity))
    return walls._replace(position=position, along=along, velocity=velocity)
