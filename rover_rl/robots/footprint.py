"""What a lidar reads at the outline of a robot, and discs that cover it."""

from __future__ import annotations

import math

import numpy as np

from rover_rl.robots.robot import Robot

COLLISION_MARGIN = 0.05
"""Distance from the outline up to which a reading is a collision of a robot that states no collision range, m."""


def collision_ranges(robot: Robot, beams: int, margin: float = COLLISION_MARGIN) -> np.ndarray:
    """Returns the lidar reading of each beam below which a robot is in collision: ``[beams]``, m.

    It is ``robot.collision_range``, if the robot states one. Otherwise, it is the distance along the beam from the
    lidar to where it leaves the footprint, and the ``margin``, m. Beams go counter-clockwise from straight ahead.
    """
    if robot.collision_range is not None:
        return np.full(beams, robot.collision_range)
    outline = robot.footprint
    corners = np.array(((outline.back, outline.right), (outline.front, outline.left)))
    angles = 2 * np.pi / beams * np.arange(beams)
    directions = np.stack((np.cos(angles), np.sin(angles)), -1)
    with np.errstate(divide="ignore", invalid="ignore"):
        ends = (corners - robot.lidar_position[:2])[:, None] / directions
    first, last = ends.min(0).max(-1), ends.max(0).min(-1)
    # A lidar beside the footprint has beams that miss it.
    return np.where((last >= first) & (last > 0), last, 0.0) + margin


def covering_discs(robot: Robot, excess: float = 0.01) -> tuple[np.ndarray, float]:
    """Covers the footprint with equal discs: x of their centers in the base frame, ``[n]``, m, and the radius, m.

    The footprint is extended to a rectangle of half length a and half width b that is symmetric about the origin. n
    discs of the radius ``sqrt(b^2 + (a / n)^2)`` cover it, the fewest that exceed its sides by at most ``excess``, m.
    """
    outline = robot.footprint
    a, b = outline.half_length, outline.half_width
    count = max(1, math.ceil(a / math.sqrt((b + excess) ** 2 - b**2)))
    return a * (2 * np.arange(count) + 1 - count) / count, math.hypot(b, a / count)
