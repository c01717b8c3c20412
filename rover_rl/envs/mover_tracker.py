"""``MoverTracker``: positions, velocities and sizes of what moves, from the lidar scans of a batch of rovers.

Readings of neighboring directions that are near each other belong to one cluster. Clusters of up to 1.6 m are compared
from scan to scan: a Kalman filter with constant velocity follows each of up to 32 tracks, and a track and a cluster
belong together if each is the nearest of the other. Everything is a tensor operation over the rows of a batch, and the
tracks are one tensor, which a policy keeps as its memory.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import torch
from tensordict import TensorDictBase
from torch import Tensor

from rover_rl.envs.config import LidarConfig
from rover_rl.envs.seen_map.scans import reading_angles
from rover_rl.envs.sensors.scan_pose import taken_at
from rover_rl.sims.robots import Robot
from rover_rl.sims.robots.fleet import Fleet

TRACKS = 32
"""Number of tracks of a row."""
STATE = 11
"""Numbers of a track: exists, x, y, velocity along x and y, radius, number of scans, time since it was last seen, and
variances of position, of position and velocity, and of velocity. All are 0 without a track."""
GAP, SPREAD = 0.25, 1.5
"""Distance of neighboring readings below which they belong together, m, and what is added for the spacing of beams."""
WIDEST = 1.6
"""Largest extent of a cluster that is tracked, m. Walls are larger."""
SMALLEST, LARGEST = 0.1, 0.8
"""Least and largest radius of a track, m."""
NOISE = 0.1
"""Standard deviation of the center of a cluster, m."""
ACCELERATION = 1.0
"""Standard deviation of the acceleration of a track, m/s^2."""
FASTEST = 1.5
"""Standard deviation of the velocity of a new track, m/s."""
GATE = 0.8
"""Largest distance of a track from its cluster, m."""
LOST = 0.6
"""Time without a cluster after which a track ends, s."""
SURE = 4
"""Number of scans after which the velocity of a track counts."""
SLOWEST = 0.3
"""Speed below which a track counts as at rest, m/s."""
_FAR = 1e4
"""Distance of what does not exist, m."""


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


class _Clusters(NamedTuple):
    """Clusters of readings: which exist ``[N, C]``, centers ``[N, C, 2]`` and radii ``[N, C]``, m."""

    exists: Tensor
    center: Tensor
    radius: Tensor


class MoverTracker:
    """Follows what moves, from scan to scan.

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
        self._spacing, self._angles = 2 * math.pi / lidar.points, reading_angles(lidar)

    def __call__(
        self, state: Tensor, lidar: Tensor, pose: Tensor, imu: Tensor, rows: Tensor | None = None
    ) -> tuple[Tensor, Tracks]:
        """Adds a scan.

        Args:
            state: tracks before, ``[N, TRACKS * STATE]``; zeros without any.
            lidar: lidar readings, ``[N, points]``, m.
            pose: x, y and z of the rovers, ``[N, 3]``, m.
            imu: pitch, roll and yaw of the rovers, ``[N, 3]``, rad.
            rows: numbers of the rows among those of different robots; ``None``: all of them.

        Returns:
            The next state, and what moves.
        """
        origin, points = self._points(lidar, pose, imu, rows)
        labels = self._labels(lidar, points)
        clusters = self._clusters(lidar, points, labels, origin)
        tracks = self._predicted(state.unflatten(-1, (TRACKS, STATE)))
        x, y = (tracks[..., None, 1 + axis] - clusters.center[:, None, :, axis] for axis in range(2))
        distance = torch.sqrt(x * x + y * y)
        distance = distance.masked_fill((tracks[..., :1] == 0) | ~clusters.exists[:, None], _FAR)
        nearest, cluster = distance.min(2)
        number = torch.arange(TRACKS, device=lidar.device)
        seen = (nearest < GATE) & (distance.amin(1).gather(1, cluster) == nearest)
        tracks = self._corrected(tracks, seen, cluster, clusters)
        owner = torch.full_like(labels[:, :1], TRACKS).repeat(1, clusters.exists.shape[1] + 1)
        owner = owner.scatter(1, torch.where(seen, cluster, clusters.exists.shape[1]), number.expand_as(cluster))[
            :, :-1
        ]
        tracks = _with_new(tracks, clusters, clusters.exists & (owner == TRACKS))
        speed = tracks[..., 3:5].norm(dim=-1)
        moves = (tracks[..., 0] > 0) & (tracks[..., 6] >= SURE) & (speed > SLOWEST)
        moves &= speed > 1.5 * tracks[..., 10].sqrt()
        padded = torch.cat((moves, torch.zeros_like(moves[:, :1])), 1)
        readings = padded.gather(1, owner.gather(1, labels)) & (lidar < self._range)
        return tracks.flatten(1), Tracks(tracks[..., 1:3], tracks[..., 3:5], tracks[..., 5], moves, readings)

    def _points(self, lidar: Tensor, pose: Tensor, imu: Tensor, rows: Tensor | None) -> tuple[Tensor, Tensor]:
        """Returns the positions of the lidars ``[N, 2]`` and of the ends of the readings ``[N, points, 2]``, m."""
        yaw = imu[:, 2:]
        mounts = self._mounts.to(lidar)
        if self._fleet is not None:
            mounts = mounts[self._fleet.index if rows is None else self._fleet.index[rows]]
        ahead, left = mounts.split(1, -1)
        offset = torch.cat((ahead * yaw.cos() - left * yaw.sin(), ahead * yaw.sin() + left * yaw.cos()), -1)
        origin = pose[:, :2] + offset
        angles = yaw + self._angles.to(lidar)
        return origin, origin[:, None] + lidar[..., None] * torch.stack((angles.cos(), angles.sin()), -1)

    def _labels(self, lidar: Tensor, points: Tensor) -> Tensor:
        """Returns the number of each reading's cluster, int64 ``[N, points]``."""
        valid = lidar < self._range
        step = (points - points.roll(-1, 1)).norm(dim=-1)
        linked = valid & valid.roll(-1, 1) & (step < GAP + SPREAD * self._spacing * lidar)
        # The first cluster may begin before direction 0.
        labels = (~linked.roll(1, 1)).long().cumsum(1)
        return torch.where(linked[:, -1:] & (labels == labels[:, -1:]), 0, labels)

    def _clusters(self, lidar: Tensor, points: Tensor, labels: Tensor, origin: Tensor) -> _Clusters:
        """Returns the clusters that may be tracked."""
        count = lidar.shape[1] + 1
        valid = (lidar < self._range).to(lidar.dtype)
        size = torch.zeros_like(lidar[:, :1]).repeat(1, count).scatter_add(1, labels, valid)
        index = labels[..., None].expand_as(points)
        blank = points.new_zeros(len(points), count, 2)
        low, high = (blank.scatter_reduce(1, index, points, kind, include_self=False) for kind in ("amin", "amax"))
        near = torch.zeros_like(size).scatter_reduce(1, labels, lidar, "amin", include_self=False)
        extent = (high - low).norm(dim=-1)
        radius = (extent / 2 + near * self._spacing / 4).clamp(SMALLEST, LARGEST)
        middle = (low + high) / 2
        away = middle - origin[:, None]
        away = away / away.norm(dim=-1, keepdim=True).clamp(min=1e-3)
        # What is seen of a disc is its front.
        return _Clusters((size > 0) & (extent < WIDEST), middle + 0.5 * radius[..., None] * away, radius)

    def _predicted(self, tracks: Tensor) -> Tensor:
        """Moves tracks by one interval."""
        dt = self._dt
        exists, position, velocity, radius, scans, unseen, a, b, c = tracks.split((1, 2, 2, 1, 1, 1, 1, 1, 1), -1)
        noise = ACCELERATION**2
        a, b = a + 2 * dt * b + dt**2 * c + noise * dt**4 / 4, b + dt * c + noise * dt**3 / 2
        c = c + noise * dt**2
        moved = torch.cat((exists, position + dt * velocity, velocity, radius, scans, unseen + dt, a, b, c), -1)
        return moved * exists

    def _corrected(self, tracks: Tensor, seen: Tensor, cluster: Tensor, clusters: _Clusters) -> Tensor:
        """Corrects the tracks that are ``seen``, by their clusters, and ends those that have been lost."""
        exists, position, velocity, radius, scans, unseen, a, b, c = tracks.split((1, 2, 2, 1, 1, 1, 1, 1, 1), -1)
        center = clusters.center.gather(1, cluster[..., None].expand(*cluster.shape, 2))
        size = clusters.radius.gather(1, cluster)[..., None]
        gain, rate = a / (a + NOISE**2), b / (a + NOISE**2)
        error = center - position
        better = torch.cat(
            (
                exists,
                position + gain * error,
                velocity + rate * error,
                # An obstacle may be hidden in part.
                torch.maximum(size, radius - 0.02),
                scans + 1,
                torch.zeros_like(unseen),
                (1 - gain) * a,
                (1 - gain) * b,
                c - rate * b,
            ),
            -1,
        )
        kept = torch.where(seen[..., None], better, tracks)
        return kept * (kept[..., 7:8] < LOST)


def _with_new(tracks: Tensor, clusters: _Clusters, new: Tensor) -> Tensor:
    """Starts tracks of the ``new`` clusters, bool ``[N, C]``, where there is room."""
    free, count = tracks[..., 0] == 0, new.shape[1]
    turn = new.long().cumsum(1) - 1
    numbers = torch.arange(count, device=new.device).expand_as(new)
    order = torch.zeros_like(turn[:, :1]).repeat(1, count + 1).scatter(1, torch.where(new, turn, count), numbers)
    place = (free.long().cumsum(1) - 1).clamp(0, count)
    starts = free & (place < new.sum(1, keepdim=True))
    cluster = order.gather(1, place)
    center = clusters.center.gather(1, cluster[..., None].expand(*cluster.shape, 2))
    one, zero = torch.ones_like(center[..., :1]), torch.zeros_like(center)
    radius = clusters.radius.gather(1, cluster)[..., None]
    fresh = (one, center, zero, radius, one, 0 * one, NOISE**2 * one, 0 * one, FASTEST**2 * one)
    return torch.where(starts[..., None], torch.cat(fresh, -1), tracks)


def tracked(tracker: MoverTracker, tensordict: TensorDictBase) -> tuple[Tensor, Tracks]:
    """Returns the next state of a policy that remembers ``tracks``, and what moves."""
    lidar = tensordict["lidar"]
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
    yaw, pose = tensordict["imu"][:, 2:], tensordict["pose"]
    cos, sin = yaw.cos(), yaw.sin()

    def turned(pairs: Tensor) -> Tensor:
        x, y = pairs.unbind(-1)
        return torch.stack((cos * x + sin * y, cos * y - sin * x), -1)

    position = turned(tracks.position - pose[:, None, :2])
    return tracks._replace(position=position, velocity=turned(tracks.velocity))
