"""Broad phase: the parts of movers that rovers may touch in a control step."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from rover_rl.robots import Robot
from rover_rl.worlds.movers.parts import Parts

MAX_ROVER_SPEED = 2.0
"""Least speed above which a point of a rover may reach something unnoticed within a control step, m/s."""


def fastest_point(robot: Robot) -> float:
    """Twice the robot's own speed, as a corner of a robot that turns is faster than its middle, m/s."""
    return max(MAX_ROVER_SPEED, 2 * robot.drive.max_speed)


@dataclass(frozen=True)
class NearParts:
    """Parts of movers near the rovers of consecutive rows, by row and nearest first. Float64.

    Attributes:
        row: index of the row within these rows, int ``[K]``.
        part: index of the part within its row, int ``[K]``.
        start: center at the start of the control step, ``[K, 3]``, m.
        orientation: orientation then, unit quaternion (x, y, z, w), ``[K, 4]``.
        velocity: velocity in the step, ``[K, 3]``, m/s.
        turn: yaw rate in the step, ``[K]``, rad/s.
    """

    row: np.ndarray
    part: np.ndarray
    start: np.ndarray
    orientation: np.ndarray
    velocity: np.ndarray
    turn: np.ndarray

    def chosen(self, index: np.ndarray) -> NearParts:
        """Returns the parts at indices ``[k]``."""
        return NearParts(*(getattr(self, item.name)[index] for item in fields(self)))


def find_near(
    parts: Parts, rows: slice, position: np.ndarray, reach: float, dt: float, speed: float = MAX_ROVER_SPEED
) -> NearParts:
    """Returns the parts of movers near rovers in a step of ``dt`` (s), at whose end the parts are.

    The rovers are in consecutive ``rows`` and were at ``position [n, 3]`` (m) at its start. ``reach`` (m) is the radius
    of a sphere around that contains one, and ``speed`` (m/s) the highest one of its points.
    """
    end, velocity, half = (getattr(parts, name)[rows].double().numpy() for name in ("position", "velocity", "half"))
    start = end - velocity * dt
    gap = np.sqrt(((start - position[:, None]) ** 2).sum(-1)) - np.sqrt((half**2).sum(-1))
    limit = reach + (np.sqrt((velocity**2).sum(-1)) + speed) * dt
    row, part = np.nonzero((parts.kind[rows].numpy() >= 0) & (gap < limit))
    order = np.lexsort((part, gap[row, part], row))
    row, part = row[order], part[order]
    turn = parts.turn[rows].double().numpy()[row, part]
    orientation = parts.orientation[rows].double().numpy()[row, part]
    return NearParts(row, part, start[row, part], turned(orientation, -turn * dt), velocity[row, part], turn)


def turned(orientation: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Turns orientations (x, y, z, w) ``[K, 4]`` by angles about the vertical ``[K]``, rad."""
    sin, cos = np.sin(angle / 2), np.cos(angle / 2)
    x, y, z, w = orientation.T
    return np.stack((cos * x - sin * y, cos * y + sin * x, cos * z + sin * w, cos * w - sin * z), -1)
