"""Footprint: outline of a robot seen from above."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from rover_rl.robots.description import Description, Frame, Shape

if TYPE_CHECKING:
    from rover_rl.robots.robot import Robot


COLLISION_MARGIN = 0.05
"""Distance from the outline up to which a reading is a collision of a robot that states no collision range, m."""


class Footprint(NamedTuple):
    """Rectangle around the wheels and the body of a robot, seen from above, in the base frame.

    Attributes:
        back: lowest x, m. Negative.
        front: highest x, m.
        right: lowest y, m. Negative.
        left: highest y, m.
    """

    back: float
    front: float
    right: float
    left: float

    @property
    def half_length(self) -> float:
        """Largest distance from the origin along x, m."""
        return max(-self.back, self.front)

    @property
    def half_width(self) -> float:
        """Largest distance from the origin along y, m."""
        return max(-self.right, self.left)

    @property
    def corner(self) -> float:
        """Radius of a disc around the origin that holds the rectangle, m."""
        return math.hypot(self.half_length, self.half_width)


@lru_cache(maxsize=64)
def footprint(robot: Robot) -> Footprint:
    """Returns the smallest rectangle around the wheels and the collision shapes fixed to the base of a robot.

    Wheels are the boxes around their cylinders or spheres. Shapes without known sizes, such as meshes, do not count.

    Example:
        >>> from rover_rl.robots import get_robot
        >>> outline = footprint(get_robot("rover_zero"))
        >>> round(outline.half_length, 3), round(outline.half_width, 3)
        (0.267, 0.225)
    """
    reach = np.array((robot.wheels.radius, robot.wheels.width / 2 or robot.wheels.radius))
    hubs = np.array(robot.wheels.hubs)[:, :2]
    low, high = [*(hubs - reach)], [*(hubs + reach)]
    description = Description(robot.urdf)
    for name, frame in description.fixed.items():
        for shape in description.links[name].shapes:
            placed = frame @ shape.frame
            half = half_sizes(placed, shape)
            if half is not None:
                low.append((placed.position - half)[:2])
                high.append((placed.position + half)[:2])
    (back, right), (front, left) = np.min(low, 0).tolist(), np.max(high, 0).tolist()
    return Footprint(back, front, right, left)


def collision_ranges(robot: Robot, beams: int, margin: float = COLLISION_MARGIN) -> np.ndarray:
    """Returns the lidar reading of each beam below which a robot is in collision: ``[beams]``, m.

    It is ``robot.collision_range`` for all beams, if the robot states one. Otherwise, it is
    the distance along the beam from the lidar to where it leaves the footprint, and the ``margin``.

    Args:
        robot: robot with the lidar.
        beams: number of beams, counter-clockwise from straight ahead.
        margin: distance from the outline that still is a collision, m.
    """
    if robot.collision_range is not None:
        return np.full(beams, robot.collision_range)
    outline = footprint(robot)
    low, high = np.array((outline.back, outline.right)), np.array((outline.front, outline.left))
    angles = 2 * np.pi / beams * np.arange(beams)
    directions = np.stack((np.cos(angles), np.sin(angles)), -1)
    with np.errstate(divide="ignore", invalid="ignore"):
        ends = (np.stack((low, high)) - robot.lidar_position[:2])[:, None] / directions
    first, last = ends.min(0).max(-1), ends.max(0).min(-1)
    # A lidar beside the footprint has beams that miss it.
    return np.where((last >= first) & (last > 0), last, 0.0) + margin


def half_sizes(frame: Frame, shape: Shape) -> np.ndarray | None:
    """Returns half the side lengths of the box around a shape whose pose is ``frame``: ``[3]``, m.

    ``None`` for a shape without known sizes.
    """
    if shape.kind == "box":
        return np.abs(frame.rotation) @ np.array(shape.sizes) / 2
    if shape.kind == "sphere":
        return np.full(3, shape.sizes[0])
    if shape.kind == "cylinder":
        radius, length = shape.sizes
        axis = np.abs(frame.rotation[:, 2])
        # A disc of the radius extends by sqrt(1 - axis^2) along each coordinate axis.
        return axis * length / 2 + radius * np.sqrt(np.maximum(1 - axis**2, 0.0))
    return None


def covering_discs(robot: Robot, excess: float = 0.01) -> tuple[np.ndarray, float]:
    """Covers the footprint with equal discs along the x axis of the robot.

    The footprint is extended to a rectangle of half length a and half width b that is symmetric about the origin. n
    discs with centers at ``a (2 i + 1 - n) / n`` and the radius ``sqrt(b^2 + (a / n)^2)`` cover it. n is the smallest
    number for which they exceed the sides of the rectangle by at most ``excess`` (m).

    Returns x of the centers, in the base frame, ``[n]``, m, and the radius, m.
    """
    outline = footprint(robot)
    a, b = outline.half_length, outline.half_width
    count = max(1, math.ceil(a / math.sqrt((b + excess) ** 2 - b**2)))
    return a * (2 * np.arange(count) + 1 - count) / count, math.hypot(b, a / count)
