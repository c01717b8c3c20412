"""Contacts between rovers and obstacles in Bullet."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rover_rl.sims.native.bullet import pybullet
from rover_rl.sims.worlds import Obstacle

MAX_SPEED = 2.0
"""Speed above which a point of a rover may reach an obstacle unnoticed within a control step, m/s."""
_DISTANCE, _NORMAL_FORCE = 8, 9
"""Indices of the distance (m, negative for a penetration) and the normal force (N) in a contact point of PyBullet."""


class NearObstacles:
    """Broad phase: finds the obstacles that rovers may touch in a control step, by axis-aligned bounding boxes.

    A query of Bullet's contacts takes a few microseconds. Most rovers are far from all obstacles and need none.

    Args:
        obstacles: obstacles of the world.
        low: lower corner of the rover's bounding box in the base frame, ``[3]``, m.
        high: upper corner, ``[3]``, m.
        dt: duration of a control step, s.
    """

    def __init__(self, obstacles: Sequence[Obstacle], low: np.ndarray, high: np.ndarray, dt: float) -> None:
        corners = [obstacle.vertices.numpy() for obstacle in obstacles]
        self._low = np.array([points.min(0) for points in corners]).reshape(-1, 3)
        self._high = np.array([points.max(0) for points in corners]).reshape(-1, 3)
        self._center, self._half = (low + high) / 2, (high - low) / 2
        self._margin = MAX_SPEED * dt

    def find(self, position: np.ndarray, rotation: np.ndarray) -> list[tuple[int, int]]:
        """Returns pairs of a rover and an obstacle near it, as indices.

        Args:
            position: positions of the base frames, ``[k, 3]``, m.
            rotation: orientations of the base frames as matrices, ``[k, 3, 3]``.
        """
        if not len(self._low):
            return []
        center = position + (rotation * self._center).sum(-1)
        half = (np.abs(rotation) * self._half).sum(-1) + self._margin
        apart = ((center - half)[:, None] > self._high) | ((center + half)[:, None] < self._low)
        return [(row, obstacle) for row, obstacle in np.argwhere(~apart.any(-1)).tolist()]


def is_touching(client: int, rover: int, obstacle: int) -> bool:
    """Returns whether a rover touches an obstacle: whether their surfaces overlap or a force acts between them.

    Bullet also keeps contact points of surfaces up to 2 cm apart. With a ``contact_threshold`` above 0, a force may act
    just before the surfaces meet.

    Args:
        client: id of the Bullet client.
        rover: id of the rover's body.
        obstacle: id of the obstacle's body.
    """
    points = pybullet.getContactPoints(rover, obstacle, physicsClientId=client)
    return any(point[_DISTANCE] <= 0.0 or point[_NORMAL_FORCE] > 0.0 for point in points)
