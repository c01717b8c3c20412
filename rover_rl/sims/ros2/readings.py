"""Conversion of ROS messages to tensors. Accepts any object with a message's attributes, such as ROS's own classes."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from rover_rl.sims.ros2.settings import Ros2Settings

SECTOR = math.radians(45)
"""Half-angle of the sector around the direction of travel in which every beam must be seen, rad.

A rover with a footprint radius of 0.35 m and a stopping distance of 0.35 m sweeps no area outside of this sector that
it has not already seen from farther away."""


class Scan(NamedTuple):
    """A lidar scan in the lidar's own layout, counter-clockwise.

    Attributes:
        ranges: ranges of the beams, ``[beams]``, m; ``inf`` is no return, ``-inf`` an object that is too close
            (REP 117).
        valid: whether each reading is valid, bool ``[beams]``.
        angle_min: angle of the first beam in the lidar's frame, rad.
        angle_increment: angle between two beams, rad, positive.
        stamp: time of the scan by the sender's clock, s.
    """

    ranges: Tensor
    valid: Tensor
    angle_min: float
    angle_increment: float
    stamp: float

    @property
    def field_of_view(self) -> float:
        """Angle that the scan covers, at most a full turn, rad."""
        return min(2 * math.pi, len(self.ranges) * self.angle_increment)


class AlignedScan(NamedTuple):
    """A scan in the environment's layout: ranges ``[beams]`` (m), counter-clockwise from straight ahead.

    ``seen``, bool ``[beams]``, says whether a valid reading covers each beam. Where none does, the range is ``inf``.
    """

    ranges: Tensor
    seen: Tensor


class MeasuredPose(NamedTuple):
    """A position ``[3]`` (m) and an orientation ``[4]`` as (x, y, z, w); ``None`` if it is unknown.

    ``imu_yaw_offset`` is the yaw of the IMU's frame in the frame of the pose, rad.
    """

    position: Tensor
    orientation: Tensor | None
    imu_yaw_offset: float = 0.0


def read_scan(msg: Any, max_invalid: float = Ros2Settings.max_invalid) -> Scan:
    """Reads a ``sensor_msgs/LaserScan``.

    A reading is invalid if it is NaN, or a finite number outside of the message's limits ``range_min`` and
    ``range_max`` (REP 117). Readings that the angles announce and ``ranges`` lacks also count as invalid. The limits
    apply only if ``range_max`` is greater than ``range_min``.

    Args:
        msg: message to read.
        max_invalid: maximum share of invalid readings, from 0 to 1.

    Raises:
        ValueError: if the scan has no readings, unusable angles, or too many invalid readings.
    """
    ranges = torch.from_numpy(np.array(msg.ranges, np.float32))
    if ranges.ndim != 1 or not len(ranges):
        raise ValueError(f"a scan must have a list of ranges, got shape {tuple(ranges.shape)}")
    angle_min, increment = float(msg.angle_min), float(msg.angle_increment)
    if not math.isfinite(angle_min) or not 1e-6 < abs(increment) < math.inf:
        raise ValueError(
            "a scan must have a finite angle_min and a finite angle_increment other than 0, "
            f"got angle_min {angle_min}, angle_increment {increment}"
        )
    low, high = float(msg.range_min), float(msg.range_max)
    valid = ~ranges.isnan()
    if high > low:
        valid &= ranges.isinf() | ((ranges >= low) & (ranges <= high))
    steps = (float(msg.angle_max) - angle_min) / increment
    announced = max(len(ranges), round(steps) + 1 if 0 <= steps < math.inf else 0)  # 0: the angles are inconsistent
    invalid = announced - int(valid.sum())
    if invalid > max_invalid * announced:
        raise ValueError(
            f"{invalid} of {announced} readings of the scan are missing, NaN or outside of its limits of {low:g} to "
            f"{high:g} m; the limit is {max_invalid:.0%}"
        )
    if increment < 0:
        ranges, valid = ranges.flip(0), valid.flip(0)
        angle_min, increment = angle_min + increment * (len(ranges) - 1), -increment
    return Scan(ranges, valid, angle_min, increment, msg.header.stamp.sec + msg.header.stamp.nanosec * 1e-9)


def read_orientation(q: Any) -> Tensor:
    """Reads and normalizes a ``geometry_msgs/Quaternion``: float32 ``[4]`` as (x, y, z, w).

    Raises:
        ValueError: if the quaternion is zero or not finite.
    """
    quaternion = torch.tensor([q.x, q.y, q.z, q.w], dtype=torch.float64)
    norm = torch.linalg.vector_norm(quaternion)
    if not 0.0 < norm < math.inf:
        raise ValueError(f"an orientation must be a finite quaternion other than zero, got {quaternion.tolist()}")
    return (quaternion / norm).float()


def read_pose(pose: Any) -> MeasuredPose:
    """Reads a ``geometry_msgs/Pose``. See :func:`read_position` and :func:`read_orientation` for errors."""
    return MeasuredPose(read_position(pose.position), read_orientation(pose.orientation))


def read_position(point: Any) -> Tensor:
    """Reads a ``geometry_msgs/Point``: float32 ``[3]``, m. Raises ``ValueError`` if a number is not finite."""
    return _finite("position", point.x, point.y, point.z)


def read_pose_array(msg: Any) -> MeasuredPose:
    """Reads the first pose of a ``geometry_msgs/PoseArray``. Its orientation may be missing or invalid.

    Raises:
        ValueError: if the array is empty, or the position is not finite.
    """
    if not len(msg.poses):
        raise ValueError("a pose array must have at least one pose, got none")
    pose = msg.poses[0]
    position = read_position(pose.position)
    try:
        return MeasuredPose(position, read_orientation(pose.orientation))
    except (ValueError, AttributeError):
        return MeasuredPose(position, None)


def read_twist(msg: Any) -> Tensor:
    """Reads forward speed (m/s) and yaw rate (rad/s) of a ``nav_msgs/Odometry``: float32 ``[2]``.

    Raises:
        ValueError: if a number is not finite.
    """
    return _finite("velocity", msg.twist.twist.linear.x, msg.twist.twist.angular.z)


def _finite(name: str, *numbers: float) -> Tensor:
    values = torch.tensor(numbers, dtype=torch.float32)
    if not torch.isfinite(values).all():
        raise ValueError(f"a {name} must be finite, got {values.tolist()}")
    return values


class ScanAlignment:
    """Converts scans to the environment's layout: a full turn of beams, counter-clockwise from straight ahead.

    Each beam has a sector, its equal share of the turn. It gets the minimum of the valid readings in its sector. A beam
    without a valid reading in its sector gets the reading nearest in angle, if that is valid and at most half an angle
    increment away. Otherwise the beam is unseen, never free.

    Args:
        beams: number of beams of the environment.
        yaw: direction of the lidar's zero angle, counter-clockwise from straight ahead, rad.
    """

    def __init__(self, beams: int, yaw: float) -> None:
        self._beams, self._yaw = beams, yaw
        self._layout: tuple[int, float, float] | None = None
        self._beam_of_reading = self._nearest_reading = torch.zeros(0, dtype=torch.int64)

    def __call__(self, scan: Scan) -> AlignedScan:
        """Converts a scan to the environment's layout."""
        layout = (len(scan.ranges), scan.angle_min, scan.angle_increment)
        if layout != self._layout:
            self._layout = layout
            self._beam_of_reading, self._nearest_reading = self._indices(*layout)
        ranges = scan.ranges.masked_fill(~scan.valid, math.inf)
        closest = torch.full((self._beams,), math.inf).scatter_reduce(0, self._beam_of_reading, ranges, "amin")
        covered = torch.zeros(self._beams, dtype=torch.bool)
        covered[self._beam_of_reading[scan.valid]] = True
        # The padded entry stands for beams without a reading nearby.
        nearest = torch.nn.functional.pad(ranges, (0, 1), value=math.inf)[self._nearest_reading]
        nearest_valid = torch.nn.functional.pad(scan.valid, (0, 1), value=False)[self._nearest_reading]
        return AlignedScan(torch.where(covered, closest, nearest), covered | nearest_valid)

    def _indices(self, count: int, angle_min: float, increment: float) -> tuple[Tensor, Tensor]:
        """Indices between readings and beams.

        Returns:
            Beam whose sector contains each reading, ``[count]``.
            Reading nearest to each beam, ``[beams]``; ``count`` if none is near enough.
        """
        turn = 2 * math.pi
        angles = angle_min + self._yaw + increment * torch.arange(count, dtype=torch.float64)
        beams = turn / self._beams * torch.arange(self._beams, dtype=torch.float64)
        beam_of_reading = (angles * self._beams / turn).round().long() % self._beams
        distances = (turn / 2 - (beams[:, None] - angles).remainder(turn)).abs().neg() + turn / 2
        distance, nearest = distances.min(-1)
        return beam_of_reading, torch.where(distance <= increment / 2 + 1e-6, nearest, count)


class UnseenGuard:
    """Blocks forward speeds towards unseen directions. Turning on the spot stays allowed, to look around.

    Args:
        angles: direction of each beam, counter-clockwise from straight ahead, ``[beams]``, rad.
    """

    def __init__(self, angles: Tensor) -> None:
        self._ahead = angles.cos() >= math.cos(SECTOR) - 1e-6
        self._behind = angles.cos() <= -math.cos(SECTOR) + 1e-6

    def blocks(self, speed: float, seen: Tensor) -> bool:
        """Whether a forward speed (m/s), backward if negative, leads towards a beam that is not ``seen [beams]``."""
        sector = self._ahead if speed > 0 else self._behind
        return speed != 0.0 and bool((sector & ~seen).any())
