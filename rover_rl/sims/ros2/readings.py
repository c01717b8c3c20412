"""From ROS messages to tensors. Any object with a message's attributes will do, real ROS messages too."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

MAX_INVALID = 0.1
"""Default share of a scan's readings that may be invalid before the whole scan counts as none."""


class Scan(NamedTuple):
    """A lidar scan in the lidar's own layout, counter-clockwise.

    Attributes:
        ranges: ``[beams]``, m; ``inf`` is no return, ``-inf`` an object that is too close (REP 117).
        valid: whether each reading tells anything, bool ``[beams]``.
        first: angle of the first beam in the lidar's frame, rad.
        increment: from one beam to the next, rad, positive.
        stamp: by the sender's clock, s.
    """

    ranges: Tensor
    valid: Tensor
    first: float
    increment: float
    stamp: float

    @property
    def field_of_view(self) -> float:
        """Angle that the scan covers, at most a full turn, rad."""
        return min(2 * math.pi, len(self.ranges) * self.increment)


class AlignedScan(NamedTuple):
    """A scan in the environment's layout: over the full turn, from straight ahead counter-clockwise.

    Attributes:
        ranges: ``[beams]``, m; ``inf`` where ``seen`` is False.
        seen: whether a valid reading covers each beam, bool ``[beams]``.
    """

    ranges: Tensor
    seen: Tensor


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


def read_scan(msg: Any, max_invalid: float = MAX_INVALID) -> Scan:
    """Reads a ``sensor_msgs/LaserScan``.

    A reading is invalid if it is NaN, or a finite number outside of the limits ``range_min`` and ``range_max`` of the
    message (REP 117). Readings that the angles announce and ``ranges`` lacks count as invalid, too. A message whose
    ``range_max`` is not above its ``range_min`` states no limits.

    Args:
        msg: the message.
        max_invalid: share of the readings that may be invalid, from 0 to 1.

    Raises:
        ValueError: for a scan without readings, with unusable angles, or with too many invalid readings.
    """
    ranges = torch.from_numpy(np.array(msg.ranges, np.float32))
    if ranges.ndim != 1 or not len(ranges):
        raise ValueError(f"a scan must have a list of ranges, got shape {tuple(ranges.shape)}")
    first, increment = float(msg.angle_min), float(msg.angle_increment)
    if not math.isfinite(first) or not 1e-6 < abs(increment) < math.inf:
        raise ValueError(f"a scan must tell its angles, got angle_min {first}, angle_increment {increment}")
    low, high = float(msg.range_min), float(msg.range_max)
    valid = ~ranges.isnan()
    if high > low:
        valid &= ranges.isinf() | ((ranges >= low) & (ranges <= high))
    announced = max(len(ranges), _announced(first, float(msg.angle_max), increment))
    invalid = announced - int(valid.sum())
    if invalid > max_invalid * announced:
        raise ValueError(
            f"{invalid} of {announced} readings of the scan are missing, NaN or outside of its limits of {low:g} to "
            f"{high:g} m; at most {max_invalid:.0%} may be"
        )
    if increment < 0:
        ranges, valid = ranges.flip(0), valid.flip(0)
        first, increment = first + increment * (len(ranges) - 1), -increment
    return Scan(ranges, valid, first, increment, msg.header.stamp.sec + msg.header.stamp.nanosec * 1e-9)


def _announced(first: float, last: float, increment: float) -> int:
    """How many readings a scan's angles (rad) announce; 0 where they announce none."""
    steps = (last - first) / increment
    return round(steps) + 1 if 0 <= steps < math.inf else 0


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
    """Turns scans into the environment's layout: ``beams`` over the full turn, from straight ahead counter-clockwise.

    Each beam gets the nearest of the valid readings that lie in its share of the turn, or, where the lidar has fewer,
    the valid reading beside it. A beam that no valid reading covers is unseen, never free.

    Args:
        beams: of the environment.
        yaw: where the zero of the lidar's angles points, rad counter-clockwise from straight ahead.
    """

    def __init__(self, beams: int, yaw: float) -> None:
        self._beams, self._yaw = beams, yaw
        self._known: tuple[int, float, float] | None = None
        self._share = self._beside = torch.zeros(0, dtype=torch.int64)

    def __call__(self, scan: Scan) -> AlignedScan:
        """The scan in the environment's layout."""
        layout = (len(scan.ranges), scan.first, scan.increment)
        if layout != self._known:
            self._known = layout
            self._share, self._beside = self._indices(*layout)
        ranges = scan.ranges.masked_fill(~scan.valid, math.inf)
        nearest = torch.full((self._beams,), math.inf).scatter_reduce(0, self._share, ranges, "amin")
        covered = torch.zeros(self._beams, dtype=torch.bool)
        covered[self._share[scan.valid]] = True
        # One more entry stands for beams that have no reading beside them.
        beside = torch.nn.functional.pad(ranges, (0, 1), value=math.inf)[self._beside]
        beside_valid = torch.nn.functional.pad(scan.valid, (0, 1), value=False)[self._beside]
        return AlignedScan(torch.where(covered, nearest, beside), covered | beside_valid)

    def _indices(self, count: int, first: float, increment: float) -> tuple[Tensor, Tensor]:
        """The beam ``[count]`` whose share each reading lies in, and the reading ``[beams]`` beside each beam."""
        turn = 2 * math.pi
        angles = first + self._yaw + increment * torch.arange(count, dtype=torch.float64)
        beams = turn / self._beams * torch.arange(self._beams, dtype=torch.float64)
        shares = (angles * self._beams / turn).round().long() % self._beams
        away = (turn / 2 - (beams[:, None] - angles).remainder(turn)).abs().neg() + turn / 2
        distance, beside = away.min(-1)
        return shares, torch.where(distance <= increment / 2 + 1e-6, beside, count)
