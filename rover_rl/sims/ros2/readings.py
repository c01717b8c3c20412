"""From ROS messages to tensors. Any object with a message's attributes will do, real ROS messages too."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor


class Scan(NamedTuple):
    """A scan as the lidar gives it, counter-clockwise.

    Attributes:
        ranges: ``[beams]``, m.
        first: angle of the first beam in the lidar's frame, rad.
        increment: from one beam to the next, rad, positive.
        stamp: by the sender's clock, s.
    """

    ranges: Tensor
    first: float
    increment: float
    stamp: float


class Place(NamedTuple):
    """A pose.

    Attributes:
        position: ``[3]``, m.
        orientation: unit quaternion ``[4]`` as (x, y, z, w); ``None`` where it is not known.
        turn: how far its frame is turned from the IMU's, rad.
    """

    position: Tensor
    orientation: Tensor | None
    turn: float = 0.0


def read_scan(msg: Any) -> Scan:
    """A ``sensor_msgs/LaserScan``.

    Raises:
        ValueError: for a scan without beams, or angles that are none.
    """
    ranges = torch.from_numpy(np.array(msg.ranges, np.float32))
    if ranges.ndim != 1 or not len(ranges):
        raise ValueError(f"a scan must have a list of ranges, got shape {tuple(ranges.shape)}")
    first, increment = float(msg.angle_min), float(msg.angle_increment)
    if not math.isfinite(first) or not 1e-6 < abs(increment) < math.inf:
        raise ValueError(f"a scan must tell its angles, got angle_min {first}, angle_increment {increment}")
    if increment < 0:
        ranges, first, increment = ranges.flip(0), first + increment * (len(ranges) - 1), -increment
    return Scan(ranges, first, increment, msg.header.stamp.sec + msg.header.stamp.nanosec * 1e-9)


def read_orientation(q: Any) -> Tensor:
    """A ``geometry_msgs/Quaternion`` of length 1, float32 ``[4]`` as (x, y, z, w).

    Raises:
        ValueError: for one that is zero or not finite.
    """
    quaternion = torch.tensor([q.x, q.y, q.z, q.w], dtype=torch.float64)
    norm = torch.linalg.vector_norm(quaternion)
    if not 0.0 < norm < math.inf:
        raise ValueError(f"an orientation must be a finite quaternion other than zero, got {quaternion.tolist()}")
    return (quaternion / norm).float()


def read_imu(msg: Any) -> Tensor:
    """Orientation of a ``sensor_msgs/Imu``: see :func:`read_orientation`."""
    return read_orientation(msg.orientation)


def read_pose(pose: Any) -> Place:
    """A ``geometry_msgs/Pose``.

    Raises:
        ValueError: for numbers that are not finite, or an orientation that is none.
    """
    return Place(read_position(pose.position), read_orientation(pose.orientation))


def read_position(point: Any) -> Tensor:
    """A ``geometry_msgs/Point``, float32 ``[3]``.

    Raises:
        ValueError: for numbers that are not finite.
    """
    position = torch.tensor([point.x, point.y, point.z], dtype=torch.float32)
    if not torch.isfinite(position).all():
        raise ValueError(f"a position must be finite, got {position.tolist()}")
    return position


def read_pose_array(msg: Any) -> Place:
    """The first pose of a ``geometry_msgs/PoseArray``, whose orientation may be left out.

    Raises:
        ValueError: for an array without poses, or a position that is not finite.
    """
    if not len(msg.poses):
        raise ValueError("a pose array must have at least one pose, got none")
    pose = msg.poses[0]
    position = read_position(pose.position)
    try:
        return Place(position, read_orientation(pose.orientation))
    except (ValueError, AttributeError):
        return Place(position, None)


def read_twist(msg: Any) -> Tensor:
    """Forward speed (m/s) and yaw rate (rad/s) of a ``nav_msgs/Odometry``, float32 ``[2]``.

    Raises:
        ValueError: for numbers that are not finite.
    """
    twist = torch.tensor([msg.twist.twist.linear.x, msg.twist.twist.angular.z], dtype=torch.float32)
    if not torch.isfinite(twist).all():
        raise ValueError(f"a velocity must be finite, got {twist.tolist()}")
    return twist


class ScanAlignment:
    """Turns scans into the environment's: ``beams`` over the full turn, from straight ahead counter-clockwise.

    Each beam gets the nearest of the lidar's readings that lie in its share of the turn, or, where the lidar has fewer,
    the reading beside it; ``inf`` where the lidar does not look.

    Args:
        beams: of the environment.
        yaw: where the zero of the lidar's angles points, rad counter-clockwise from straight ahead.
    """

    def __init__(self, beams: int, yaw: float) -> None:
        self._beams, self._yaw = beams, yaw
        self._known: tuple[int, float, float] | None = None
        self._share = self._beside = torch.zeros(0, dtype=torch.int64)

    def __call__(self, scan: Scan) -> Tensor:
        """Ranges ``[beams]``, m; readings that are no number count as no return."""
        layout = (len(scan.ranges), scan.first, scan.increment)
        if layout != self._known:
            self._known = layout
            self._share, self._beside = self._indices(*layout)
        ranges = scan.ranges.nan_to_num(nan=math.inf, posinf=math.inf, neginf=-math.inf)
        nearest = torch.full((self._beams,), math.inf).scatter_reduce(0, self._share, ranges, "amin")
        beside = torch.cat((ranges, ranges.new_full((1,), math.inf)))[self._beside]
        return torch.where(torch.isposinf(nearest), beside, nearest)

    def _indices(self, count: int, first: float, increment: float) -> tuple[Tensor, Tensor]:
        """The beam ``[count]`` whose share each reading lies in, and the reading ``[beams]`` beside each beam."""
        turn = 2 * math.pi
        angles = first + self._yaw + increment * torch.arange(count, dtype=torch.float64)
        beams = turn / self._beams * torch.arange(self._beams, dtype=torch.float64)
        shares = (angles * self._beams / turn).round().long() % self._beams
        away = (turn / 2 - (beams[:, None] - angles).remainder(turn)).abs().neg() + turn / 2
        distance, beside = away.min(-1)
        return shares, torch.where(distance <= increment / 2 + 1e-6, beside, count)
