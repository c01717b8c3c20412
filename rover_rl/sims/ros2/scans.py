"""Lidar scans of a live rover: reading, conversion to the environment's layout, and the guard of unseen directions."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from rover_rl.sims.ros2.messages import seconds_of
from rover_rl.sims.ros2.settings import Ros2Settings
from rover_rl.sims.rover_state import beam_angles

SECTOR = math.radians(45)
"""Half-angle of the sector around the direction of travel in which every beam must be seen, rad. With a footprint
radius and a stopping distance of 0.35 m, a rover sweeps no area outside that it has not seen from farther away."""
TURN = 2 * math.pi


class Scan(NamedTuple):
    """A lidar scan in the lidar's own layout: ranges ``[beams]`` (m), counter-clockwise from ``angle_min`` (rad).

    A range of ``inf`` is no return, one of ``-inf`` an object that is too close (REP 117). ``valid`` is bool
    ``[beams]``. ``stamp`` is the time by the sender's clock, s.
    """

    ranges: Tensor
    valid: Tensor
    angle_min: float
    angle_increment: float
    stamp: float

    @property
    def field_of_view(self) -> float:
        """Angle that the scan covers, at most a full turn, rad."""
        return min(TURN, len(self.ranges) * self.angle_increment)

    def mounted(self, yaw: float, inverted: bool = False) -> Scan:
        """Returns the scan of a lidar that is turned by ``yaw`` (rad) on a robot, from straight ahead of the robot.

        If ``inverted``, it hangs upside down, by a roll of pi before the turn.
        """
        if not inverted:
            return self._replace(angle_min=yaw + self.angle_min)
        last = self.angle_min + self.angle_increment * (len(self.ranges) - 1)
        return self._replace(ranges=self.ranges.flip(0), valid=self.valid.flip(0), angle_min=yaw - last)


def read_scan(msg: Any, max_invalid: float = Ros2Settings.max_invalid) -> Scan:
    """Reads a ``sensor_msgs/LaserScan``, of which a share of at most ``max_invalid`` readings may be invalid.

    They are NaN, finite but outside of the message's limits, if it has such (REP 117), or announced by the angles and
    missing. Raises ``ValueError`` if there are no readings, unusable angles, or too many invalid readings.
    """
    ranges = torch.from_numpy(np.array(msg.ranges, np.float32))
    if ranges.ndim != 1 or not len(ranges):
        raise ValueError(f"a scan must have a list of ranges, got shape {tuple(ranges.shape)}")
    angle_min, increment = float(msg.angle_min), float(msg.angle_increment)
    if not math.isfinite(angle_min) or not 1e-6 < abs(increment) < math.inf:
        got = f"got angle_min {angle_min}, angle_increment {increment}"
        raise ValueError(f"a scan must have a finite angle_min and a finite angle_increment other than 0, {got}")
    low, high = float(msg.range_min), float(msg.range_max)
    valid = ~ranges.isnan()
    if high > low:
        valid &= ranges.isinf() | ((ranges >= low) & (ranges <= high))
    steps = (float(msg.angle_max) - angle_min) / increment
    announced = max(len(ranges), round(steps) + 1 if 0 <= steps < math.inf else 0)  # 0: the angles are inconsistent
    invalid = announced - int(valid.sum())
    if invalid > max_invalid * announced:
        which = f"missing, NaN or outside of its limits of {low:g} to {high:g} m"
        raise ValueError(f"{invalid} of {announced} readings of the scan are {which}; the limit is {max_invalid:.0%}")
    if increment < 0:
        ranges, valid = ranges.flip(0), valid.flip(0)
        angle_min, increment = angle_min + increment * (len(ranges) - 1), -increment
    return Scan(ranges, valid, angle_min, increment, seconds_of(msg.header.stamp))


def aligned(scan: Scan, beams: int) -> tuple[Tensor, Tensor]:
    """Converts a mounted scan to a full turn of beams, counter-clockwise from straight ahead.

    Returns ranges ``[beams]``, m, and which beams are seen, bool ``[beams]``. A beam gets the minimum of the valid
    readings in its sector, its equal share of the turn. Without one, it gets the reading nearest in angle, if that is
    valid and at most half an angle increment away. Otherwise, it is unseen, never free, with the range ``inf``.
    """
    layout = len(scan.ranges), scan.angle_min, scan.angle_increment
    beam_of_reading, nearest, is_near = _beams_and_readings(beams, *layout)
    ranges = scan.ranges.masked_fill(~scan.valid, math.inf)
    closest = torch.full((beams,), math.inf).scatter_reduce(0, beam_of_reading, ranges, "amin")
    covered = beam_of_reading[scan.valid].bincount(minlength=beams) > 0
    near = ranges[nearest].masked_fill(~is_near, math.inf)
    return torch.where(covered, closest, near), covered | (is_near & scan.valid[nearest])


@lru_cache(maxsize=1)  # the layout of a lidar's scans seldom changes
def _beams_and_readings(beam_count: int, count: int, first: float, increment: float) -> tuple[Tensor, Tensor, Tensor]:
    """Returns the beam whose sector has each reading, and each beam's nearest reading and whether that is near it."""
    angles = first + increment * torch.arange(count, dtype=torch.float64)
    beams = TURN / beam_count * torch.arange(beam_count, dtype=torch.float64)
    beam_of_reading = (angles * beam_count / TURN).round().long() % beam_count
    distances = TURN / 2 - (TURN / 2 - (beams[:, None] - angles).remainder(TURN)).abs()
    distance, nearest = distances.min(-1)
    return beam_of_reading, nearest, distance <= increment / 2 + 1e-6


def cut(scan: Scan, points: int) -> Tensor | None:
    """Returns the nearest valid reading of each segment of a mounted scan, ``[points]``, m; ``inf`` where none is.

    Segments are as equal as can be, from straight ahead on: none has more than one reading more than another. ``None``
    if a full turn has fewer readings than segments.
    """
    segment = _segment_of_reading(points, len(scan.ranges), scan.angle_min, scan.angle_increment)
    if segment is None:
        return None
    ranges = scan.ranges.masked_fill(~scan.valid, math.inf)
    return torch.full((points,), math.inf).scatter_reduce(0, segment, ranges, "amin")


@lru_cache(maxsize=1)
def _segment_of_reading(points: int, count: int, first: float, increment: float) -> Tensor | None:
    turn = max(1, round(TURN / increment))
    if turn < points:
        return None
    # The first reading at or after straight ahead begins the first segment. A quarter of an increment allows for a
    # rounded mounting angle.
    place = (first / increment + torch.arange(count, dtype=torch.float64) + 0.25).floor().long() % turn
    sizes = torch.tensor([len(part) for part in torch.arange(turn).tensor_split(points)])
    return torch.arange(points).repeat_interleave(sizes)[place]


def is_blocked(speed: float, seen: Tensor) -> bool:
    """Whether a forward speed (m/s), backward if negative, leads towards a beam that is not ``seen [beams]``.

    Turning on the spot stays allowed, to look around.
    """
    along = math.copysign(1.0, speed) * beam_angles(len(seen)).float().cos()
    return speed != 0.0 and bool((~seen & (along >= math.cos(SECTOR) - 1e-6)).any())
