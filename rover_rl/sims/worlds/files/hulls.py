"""Obstacles: convex solids in place of the solids and surfaces of a file."""

from __future__ import annotations

import math

import numpy as np
import torch
from scipy.spatial import ConvexHull, QhullError

from rover_rl.sims.worlds.files.components import is_closed, signed_volume
from rover_rl.sims.worlds.files.contents import Piece
from rover_rl.sims.worlds.files.decomposition import decompose
from rover_rl.sims.worlds.files.plates import plates
from rover_rl.sims.worlds.obstacles import Obstacle

MAX_VERTICES = 256
"""Largest number of vertices of one convex solid."""
MAX_PLATES = 400
"""Largest number of plates that replace one open surface."""
THINNEST = 0.005
"""Thickness below which a solid is a sheet, m."""


def obstacles_of(piece: Piece, error: float) -> list[Obstacle]:
    """Returns convex solids in place of a connected piece.

    - A convex piece, or one that differs from its convex hull by at most ``error``, becomes its hull.
    - A closed piece is decomposed (``coacd``).
    - An open surface, or a flat sheet, becomes plates of 2 cm, with the surface in the middle. If that takes more than
      :data:`MAX_PLATES`, the surface is closed by remeshing, and decomposed.

    Args:
        piece: connected piece.
        error: accepted distance between the surfaces, m.

    Raises:
        ValueError: if the piece cannot be decomposed.
    """
    points = piece.vertices
    hull = _hull(points)
    if piece.faces is None:
        if hull is None:
            raise ValueError(f"{piece.name} has no volume")
        return [_simplified(points, hull, error)]
    closed = is_closed(piece.faces)
    faces = piece.faces[:, ::-1] if closed and signed_volume(points, piece.faces) < 0 else piece.faces
    if hull is not None and _depth(points, faces, hull) <= error and (closed or _faces_outward(points, faces, hull)):
        return [_simplified(points, hull, error)]
    if not closed:
        flat = plates(points, faces, MAX_PLATES)
        if flat is not None:
            return [Obstacle(torch.from_numpy(plate)) for plate in flat]
    return [Obstacle(torch.from_numpy(part)) for part in decompose(piece.name, points, faces, error, closed)]


def _hull(points: np.ndarray) -> ConvexHull | None:
    """Returns the convex hull of points. ``None`` if it is thinner than :data:`THINNEST`."""
    if len(points) < 4:
        return None
    thinnest = np.linalg.svd(points - points.mean(0), compute_uv=False)[2] if len(points) > 2 else 0.0
    if thinnest < 1e-9:
        return None
    try:
        hull = ConvexHull(points)
    except (QhullError, ValueError):
        return None
    # The width along the normal of each facet: the least of them is the thickness.
    heights = hull.equations[:, :3] @ points[hull.vertices].T + hull.equations[:, 3:]
    return hull if -heights.min(1).max() >= THINNEST else None


def _depth(points: np.ndarray, faces: np.ndarray, hull: ConvexHull) -> float:
    """Returns how deep a surface lies in its convex hull at most, by samples, m."""
    corners = points[faces]
    shares = np.array([[1, 1, 1], [4, 1, 1], [1, 4, 1], [1, 1, 4], [1, 1, 0], [1, 0, 1], [0, 1, 1]], dtype=float)
    samples = np.einsum("sk,fkd->fsd", shares / shares.sum(1, keepdims=True), corners).reshape(-1, 3)
    samples = np.concatenate((points, samples))
    planes = np.unique(hull.equations.round(9), axis=0)
    step = max(1, 20_000_000 // len(planes))
    parts = (samples[k : k + step] for k in range(0, len(samples), step))
    return max(float((-(part @ planes[:, :3].T + planes[:, 3])).min(1).max()) for part in parts)


def _faces_outward(points: np.ndarray, faces: np.ndarray, hull: ConvexHull) -> bool:
    """Returns whether most of an open surface faces out of its hull, as a crate does and a room seen from within."""
    a, b, c = (points[faces[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    return float((((a + b + c) / 3 - points[hull.vertices].mean(0)) * normal).sum()) > 0


def _simplified(points: np.ndarray, hull: ConvexHull, error: float) -> Obstacle:
    """Returns a hull with few vertices: the outermost in many directions."""
    corners = points[hull.vertices]
    count = MAX_VERTICES
    while len(corners) > count:
        k = np.arange(count) + 0.5
        polar, azimuth = np.arccos(1 - 2 * k / count), math.pi * (1 + math.sqrt(5)) * k
        directions = np.stack((np.cos(azimuth) * np.sin(polar), np.sin(azimuth) * np.sin(polar), np.cos(polar)), -1)
        chosen = corners[np.unique((corners @ directions.T).argmax(0))]
        planes = ConvexHull(chosen).equations
        if (corners @ planes[:, :3].T + planes[:, 3]).max() <= error / 2:
            return Obstacle(torch.from_numpy(chosen))
        count *= 2
    return Obstacle(torch.from_numpy(corners))
