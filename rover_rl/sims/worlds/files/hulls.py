"""Obstacles: convex solids in place of the solids and surfaces of a file."""

from __future__ import annotations

import numpy as np
import torch
from scipy.spatial import ConvexHull, QhullError

from rover_rl.option_names import written
from rover_rl.sims.worlds.files.contents import Piece
from rover_rl.sims.worlds.files.decomposition import decompose
from rover_rl.sims.worlds.files.triangles import connected, face_normals, is_closed, merge_triangles, signed_volume
from rover_rl.sims.worlds.obstacles import Obstacle, even_directions

FEW_VERTICES = 256
"""Number of vertices of a convex solid up to which all are kept."""
MAX_SAMPLES = 50_000
"""Largest number of points of a surface that are compared with its convex hull."""
MAX_PLATES = 400
"""Largest number of plates that replace one open surface."""
HALF_THICKNESS = 0.01
"""Distance of both faces of a plate from the surface, m."""
SAME_PLANE = 1e-4
"""Largest difference of the unit normals of neighboring triangles in one plane."""
THINNEST = 0.005
"""Thickness below which a solid is a sheet, m."""
MAX_TRIANGLES = 170_000
"""Largest number of triangles of all obstacles: Bullet's limit for the mesh that takes the lidar rays."""


def check_triangles(triangles: int) -> None:
    """Raises a ``ValueError`` if the simulators do not take that many triangles of all obstacles."""
    if triangles > MAX_TRIANGLES:
        raise ValueError(
            f"the obstacles have more than {MAX_TRIANGLES:,} triangles, which the simulators do not take; simplify the "
            f"meshes, or accept a larger {written('obstacle_error')}"
        )


def obstacles_of(piece: Piece, error: float) -> list[Obstacle]:
    """Returns convex solids in place of a connected piece.

    - A convex piece, or one that differs from its convex hull by at most ``error`` (m), becomes its hull.
    - A closed piece is decomposed (``coacd``).
    - An open surface, or a flat sheet, becomes plates of 2 cm, with the surface in the middle. If that takes more than
      :data:`MAX_PLATES`, the surface is closed by remeshing, and decomposed.
    """
    return [Obstacle(torch.from_numpy(points)) for points in _convex_parts(piece, error)]


def _convex_parts(piece: Piece, error: float) -> list[np.ndarray]:
    """Returns points whose convex hulls replace a piece, each ``[K, 3]``, m."""
    points = piece.vertices
    hull = _hull(points)
    if piece.faces is None:
        if hull is None:
            raise ValueError(f"{piece.name} has no volume")
        return [_few_corners(points[hull.vertices], error / 4)]
    closed = is_closed(piece.faces)
    faces = piece.faces[:, ::-1] if closed and signed_volume(points, piece.faces) < 0 else piece.faces
    if hull is not None and (closed or _faces_outward(points, faces, hull)):
        corners = _few_corners(points[hull.vertices], error / 4)
        if _depth(points, faces, corners) <= error:
            return [corners]
    plates = None if closed else _plates(points, faces)
    return decompose(piece.name, points, faces, error, closed) if plates is None else plates


def _hull(points: np.ndarray) -> ConvexHull | None:
    """Returns the convex hull of points. ``None`` if it is thinner than :data:`THINNEST`."""
    if len(points) < 4 or np.linalg.svd(points - points.mean(0), compute_uv=False)[2] < 1e-9:
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
    shares = np.array([[1, 1, 1], [4, 1, 1], [1, 4, 1], [1, 1, 4], [1, 1, 0], [1, 0, 1], [0, 1, 1]], dtype=float)
    samples = np.einsum("sk,fkd->fsd", shares / shares.sum(1, keepdims=True), points[faces]).reshape(-1, 3)
    samples = np.concatenate((points, samples))
    samples = samples[:: -(-len(samples) // MAX_SAMPLES)]
    planes = np.unique(ConvexHull(outer).equations.round(9), axis=0)
    step = max(1, 20_000_000 // len(planes))
    parts = (samples[k : k + step] for k in range(0, len(samples), step))
    return max(float((-(part @ planes[:, :3].T + planes[:, 3])).min(1).max()) for part in parts)


def _faces_outward(points: np.ndarray, faces: np.ndarray, hull: ConvexHull) -> bool:
    """Returns whether most of an open surface faces out of its hull, as a crate does and a room seen from within."""
    outward = points[faces].mean(1) - points[hull.vertices].mean(0)
    return float((outward * face_normals(points, faces)).sum()) > 0


def _few_corners(corners: np.ndarray, error: float) -> np.ndarray:
    """Returns the outermost corners of a convex solid in so many directions that their hull is within ``error``."""
    count = FEW_VERTICES
    while len(corners) > count:
        chosen = corners[np.unique((corners @ even_directions(count).T).argmax(0))]
        hull = _hull(chosen)
        if hull is not None and (corners @ hull.equations[:, :3].T + hull.equations[:, 3]).max() <= error:
            return chosen
        count *= 2
    return corners


def _plates(vertices: np.ndarray, faces: np.ndarray) -> list[np.ndarray] | None:
    """Returns the points of convex plates with a surface in their middle. ``None`` if there would be too many."""
    normals = face_normals(vertices, faces)
    normals = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    found: list[np.ndarray] = []
    for group in connected(faces, normals, SAME_PLANE):
        normal = normals[group[0]]
        first = np.cross(normal, np.eye(3)[np.abs(normal).argmin()])
        first = first / np.linalg.norm(first)
        flat = vertices @ np.stack((first, np.cross(normal, first)), -1)
        for polygon in merge_triangles(flat, faces[group]):
            sides = [vertices[polygon] + side * HALF_THICKNESS * normal for side in (-1, 1)]
            found.append(np.concatenate(sides))
        if len(found) > MAX_PLATES:
            return None
    return found
