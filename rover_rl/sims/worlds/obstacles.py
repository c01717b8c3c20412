"""Obstacles: convex solids, the one kind of thing besides the ground that a rover meets."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
import torch
from scipy.spatial import ConvexHull, QhullError
from torch import Tensor


@dataclass(frozen=True, eq=False)
class Obstacle:
    """A convex solid that stands still.

    Args:
        vertices: corner points ``[V, 3]`` in meters, world frame; the solid is their convex hull.

    Attributes:
        faces: triangles ``[F, 3]`` into ``vertices``, counter-clockwise from outside.
        planes: half-spaces ``[P, 4]``: a point ``p`` is inside where ``planes[:, :3] @ p + planes[:, 3] <=
            0`` for all.

    Raises:
        ValueError: for fewer than four points, non-finite points, or points in one plane.
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
        """Which of ``points [..., 3]`` lie inside: bool ``[...]``."""
        planes = self.planes.to(points)
        return (points @ planes[:, :3].T + planes[:, 3] <= 0).all(-1)

    @property
    def footprint(self) -> Tensor:
        """Outline seen from above: a convex polygon ``[K, 2]`` in meters, counter-clockwise."""
        flat = self.vertices[:, :2].numpy()
        return torch.from_numpy(flat[ConvexHull(flat).vertices])


def box(
    center: tuple[float, float, float],
    size: tuple[float, float, float],
    yaw: float = 0.0,
    pitch: float = 0.0,
    roll: float = 0.0,
) -> Obstacle:
    """A box of ``size`` (x, y, z; m) around ``center``, turned by ``roll``, ``pitch``, ``yaw`` (rad, 'sxyz').

    Raises:
        ValueError: for a size that is not positive.
    """
    if min(size) <= 0:
        raise ValueError(f"the sides of a box must be positive lengths in meters, got {tuple(size)}")
    corners = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)]) * np.asarray(size)
    return Obstacle(torch.from_numpy(corners @ _rotation(roll, pitch, yaw).T + np.asarray(center)))


def cylinder(center: tuple[float, float, float], radius: float, height: float, sides: int = 16) -> Obstacle:
    """An upright pillar around ``center``: a prism of ``sides`` sides with its corners on the circle.

    Raises:
        ValueError: for a radius or height that is not positive, or fewer than three sides.
    """
    if radius <= 0 or height <= 0 or sides < 3:
        raise ValueError(f"a cylinder needs radius > 0, height > 0, sides >= 3; got {radius}, {height}, {sides}")
    turn = 2 * math.pi * np.arange(sides) / sides
    ring = np.stack((radius * np.cos(turn), radius * np.sin(turn)), -1)
    lower, upper = np.full((sides, 1), -height / 2), np.full((sides, 1), height / 2)
    points = np.concatenate((np.hstack((ring, lower)), np.hstack((ring, upper))))
    return Obstacle(torch.from_numpy(points + np.asarray(center)))


def boulder(center: tuple[float, float, float], radius: float, rng: np.random.Generator, points: int = 24) -> Obstacle:
    """A rock: the hull of ``points`` points at 0.75 to 1 times ``radius`` (m) from ``rng``, a little flat.

    Raises:
        ValueError: for a radius that is not positive.
    """
    if radius <= 0:
        raise ValueError(f"the radius of a boulder must be positive, got {radius}")
    # A Fibonacci sphere spreads the directions evenly, so that no rock is a sliver.
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
