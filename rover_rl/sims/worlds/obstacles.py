"""Obstacles: static convex solids."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
import torch
from scipy.spatial import ConvexHull, QhullError
from torch import Tensor


@dataclass(frozen=True, eq=False)
class Obstacle:
    """Static convex solid.

    Args:
        vertices: points in the world frame whose convex hull is the solid, ``[V, 3]``, m. Points inside the hull are
            dropped.

    Attributes:
        faces: triangles as indices into ``vertices``, counter-clockwise from outside, ``[F, 3]``.
        planes: half-spaces ``[P, 4]``. A point ``p`` is inside if ``planes[:, :3] @ p + planes[:, 3] <= 0`` for all.

    Raises:
        ValueError: if there are fewer than four points, a point is not finite, or all points lie in one plane.
    """

    vertices: Tensor
    faces: Tensor = field(init=False)
    planes: Tensor = field(init=False)

    def __post_init__(self) -> None:
        points = np.asarray(self.vertices, dtype=np.float64)
        if points.ndim != 2 or points.shape[-1] != 3 or not np.isfinite(points).all():
            raise ValueError(f"vertices must be finite points [V, 3] in meters, got shape {points.shape}")
        try:
            hull = ConvexHull(points)
        except (QhullError, ValueError) as error:
            raise ValueError("an obstacle needs at least four points that do not lie in one plane") from error
        corners = np.unique(hull.simplices)
        renumbered = np.searchsorted(corners, hull.simplices)
        outward = hull.equations[:, :3]
        a, b, c = (points[hull.simplices[:, k]] for k in range(3))
        inward = (np.cross(b - a, c - a) * outward).sum(1) < 0
        renumbered[inward] = renumbered[inward][:, ::-1]
        object.__setattr__(self, "vertices", torch.from_numpy(points[corners]))
        object.__setattr__(self, "faces", torch.from_numpy(renumbered.astype(np.int64)))
        object.__setattr__(self, "planes", torch.from_numpy(np.unique(hull.equations.round(12), axis=0)))

    def contains(self, points: Tensor) -> Tensor:
        """Returns which of ``points [..., 3]`` (m) are inside: bool ``[...]``."""
        planes = self.planes.to(points)
        return (points @ planes[:, :3].T + planes[:, 3] <= 0).all(-1)

    @property
    def footprint(self) -> Tensor:
        """Outline from above: vertices of a convex polygon in counter-clockwise order, ``[K, 2]``, m."""
        flat = self.vertices[:, :2].numpy()
        return torch.from_numpy(flat[ConvexHull(flat).vertices])


def box(
    center: tuple[float, float, float],
    size: tuple[float, float, float],
    yaw: float = 0.0,
    pitch: float = 0.0,
    roll: float = 0.0,
) -> Obstacle:
    """Creates a box.

    Args:
        center: center ``(x, y, z)``, m.
        size: side lengths along x, y and z before the rotation, m.
        yaw: rotation about the fixed z axis, applied last, rad.
        pitch: rotation about the fixed y axis, rad.
        roll: rotation about the fixed x axis, applied first, rad.

    Raises:
        ValueError: if a side length is not positive.
    """
    if min(size) <= 0:
        raise ValueError(f"the sides of a box must be positive lengths in meters, got {tuple(size)}")
    corners = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)]) * np.asarray(size)
    return Obstacle(torch.from_numpy(corners @ _rotation(roll, pitch, yaw).T + np.asarray(center)))


def cylinder(center: tuple[float, float, float], radius: float, height: float, sides: int = 16) -> Obstacle:
    """Creates an upright cylinder, approximated by a prism whose vertices lie on the circle.

    Args:
        center: center ``(x, y, z)``, m.
        radius: radius, m.
        height: height, m.
        sides: number of sides of the prism.

    Raises:
        ValueError: if the radius or the height is not positive, or there are fewer than three sides.
    """
    if radius <= 0 or height <= 0 or sides < 3:
        raise ValueError(f"a cylinder needs radius > 0, height > 0, sides >= 3; got {radius}, {height}, {sides}")
    turn = 2 * math.pi * np.arange(sides) / sides
    ring = np.stack((radius * np.cos(turn), radius * np.sin(turn)), -1)
    lower, upper = np.full((sides, 1), -height / 2), np.full((sides, 1), height / 2)
    points = np.concatenate((np.hstack((ring, lower)), np.hstack((ring, upper))))
    return Obstacle(torch.from_numpy(points + np.asarray(center)))


def boulder(center: tuple[float, float, float], radius: float, rng: np.random.Generator, points: int = 24) -> Obstacle:
    """Creates a random, slightly flattened rock: the convex hull of points at 0.75 to 1 times ``radius``.

    Args:
        center: center ``(x, y, z)``, m.
        radius: maximum distance of the surface from the center, m.
        rng: random number generator.
        points: number of points.

    Raises:
        ValueError: if the radius is not positive.
    """
    if radius <= 0:
        raise ValueError(f"the radius of a boulder must be positive, got {radius}")
    # A Fibonacci sphere spaces the directions evenly, which avoids thin shapes.
    k = np.arange(points) + 0.5
    polar, azimuth = (
        np.arccos(1 - 2 * k / points),
        math.pi * (1 + math.sqrt(5)) * k + rng.uniform(0, 2 * math.pi),
    )
    directions = np.stack(
        (np.cos(azimuth) * np.sin(polar), np.sin(azimuth) * np.sin(polar), 0.8 * np.cos(polar)),
        -1,
    )
    lengths = radius * rng.uniform(0.75, 1.0, (points, 1))
    return Obstacle(torch.from_numpy(directions * lengths + np.asarray(center)))


def _rotation(roll: float, pitch: float, yaw: float) -> np.ndarray:
    (cr, sr), (cp, sp), (cy, sy) = ((math.cos(a), math.sin(a)) for a in (roll, pitch, yaw))
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )
