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

FEW_VERTICES = 256
"""Number of vertices of a convex solid up to which all are kept."""
MAX_SAMPLES = 50_000
"""Largest number of points of a surface that are compared with its convex hull."""
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
        return [Obstacle(torch.from_numpy(_few_corners(points[hull.vertices], error / 4)))]
    closed = is_closed(piece.faces)
    faces = piece.faces[:, ::-1] if closed and signed_volume(points, piece.faces) < 0 else piece.faces
    if hull is not None and (closed or _faces_outward(points, faces, hull)):
        corners = _few_corners(points[hull.vertices], error / 4)
        if _depth(points, faces, corners) <= error:
            return [Obstacle(torch.from_numpy(corners))]
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
    # The width along the normal of each facet: the least of them is the thickness. Of many facets, some are enough.
    facets = hull.equations[:: len(hull.equations) // 500 + 1]
    heights = facets[:, :3] @ points[hull.vertices].T + facets[:, 3:]
    return hull if -heights.min(1).max() >= THINNEST else None


def _depth(points: np.ndarray, faces: np.ndarray, outer: np.ndarray) -> float:
    """Returns how deep a surface lies in the convex hull of the points ``outer`` at most, by samples, m."""
    corners = points[faces]
    shares = np.array([[1, 1, 1], [4, 1, 1], [1, 4, 1], [1, 1, 4], [1, 1, 0], [1, 0, 1], [0, 1, 1]], dtype=float)
    samples = np.einsum("sk,fkd->fsd", shares / shares.sum(1, keepdims=True), corners).reshape(-1, 3)
    samples = np.concatenate((points, samples))
    samples = samples[:: -(-len(samples) // MAX_SAMPLES)]
    planes = np.unique(ConvexHull(outer).equations.round(9), axis=0)
    step = max(1, 20_000_000 // len(planes))
    parts = (samples[k : k + step] for k in range(0, len(samples), step))
    return max(float((-(part @ planes[:, :3].T + planes[:, 3])).min(1).max()) for part in parts)


def _faces_outward(points: np.ndarray, faces: np.ndarray, hull: ConvexHull) -> bool:
    """Returns whether most of an open surface faces out of its hull, as a crate does and a room seen from within."""
    a, b, c = (points[faces[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    return float((((a + b + c) / 3 - points[hull.vertices].mean(0)) * normal).sum()) > 0


def _few_corners(corners: np.ndarray, error: float) -> np.ndarray:
    """Returns the outermost corners of a convex solid in so many directions that their hull is within ``error``."""
    count = FEW_VERTICES
    while len(corners) > count:
        k = np.arange(count) + 0.5
        # A Fibonacci sphere spaces the directions evenly.
        polar, azimuth = np.arccos(1 - 2 * k / count), math.pi * (1 + math.sqrt(5)) * k
        directions = np.stack((np.cos(azimuth) * np.sin(polar), np.sin(azimuth) * np.sin(polar), np.cos(polar)), -1)
        chosen = corners[np.unique((corners @ directions.T).argmax(0))]
        hull = _hull(chosen)
        if hull is not None and (corners @ hull.equations[:, :3].T + hull.equations[:, 3]).max() <= error:
            return chosen
        count *= 2
    return corners
