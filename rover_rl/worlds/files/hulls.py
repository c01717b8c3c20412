"""Obstacles: convex solids in place of the solids and surfaces of a file."""

from __future__ import annotations

import numpy as np
from scipy.spatial import ConvexHull

from rover_rl.option_names import written
from rover_rl.worlds.files.contents import Piece
from rover_rl.worlds.files.decomposition import decompose
from rover_rl.worlds.files.triangles import (
    convex_hull,
    distances,
    face_normals,
    is_closed,
    random_points,
    signed_volume,
    surface_samples,
)
from rover_rl.worlds.solids import Solids, even_directions, hull

FEW_VERTICES = 256
"""Number of vertices of a convex solid up to which all are kept."""
MAX_SAMPLES = 50_000
"""Largest number of points of a surface that are compared with its convex hull."""
THINNEST = 0.0005
"""Thickness below which a solid is a sheet, m."""
FLATTEST = 1e-6
"""Thickness below which points have no volume, m."""
CONVEX = 1.001
"""Largest volume of the convex hull of a convex solid, by that of the solid."""
NEARLY_CONVEX = 1.5
"""Largest volume of the convex hull that replaces a solid, by that of the solid."""
MAX_TRIANGLES = 170_000
"""Largest number of triangles of all obstacles: Bullet's limit for the mesh that takes the lidar rays."""


def check_triangles(triangles: int) -> None:
    """Raises a ``ValueError`` if the simulators do not take that many triangles of all obstacles."""
    if triangles > MAX_TRIANGLES:
        raise ValueError(
            f"the obstacles have more than {MAX_TRIANGLES:,} triangles, which the simulators do not take; simplify the "
            f"meshes, or accept a larger {written('obstacle_error')}"
        )


def obstacles_of(piece: Piece, error: float) -> list[Solids]:
    """Returns convex solids in place of a connected piece.

    - A convex piece, or one that differs from its convex hull by at most ``error`` (m), becomes its hull.
    - All others are decomposed. An open surface, or a sheet with two sides, becomes plates of 2 cm, with the surface in
      the middle.

    Raises:
        ValueError: if the piece has no volume and no surface, or cannot be decomposed.
    """
    turn, place = piece.pose[:3, :3], piece.pose[:3, 3]
    return [hull(part @ turn.T + place) for part in _convex_parts(piece, error)]


def _convex_parts(piece: Piece, error: float) -> list[np.ndarray]:
    """Returns points whose convex hulls replace a piece, each ``[K, 3]``, m, in the frame of the piece."""
    points, faces = piece.points, piece.faces
    hull = _hull(points)
    if faces is None:
        if hull is None:
            raise ValueError(f"{piece.name} has no volume")
        return [_few_corners(points[hull.vertices], error / 4)]
    closed = is_closed(faces)
    volume = signed_volume(points, faces) if closed else 0.0
    if closed and 4 * abs(volume) <= THINNEST * np.linalg.norm(face_normals(points, faces), axis=1).sum():
        closed = False
    elif volume < 0:
        faces, volume = faces[:, ::-1], -volume
    if hull is not None and (closed or _faces_outward(points, faces, hull)):
        corners = _few_corners(points[hull.vertices], error / 4)
        up = None if closed else piece.pose[2, :3]
        if _depth(points, faces, corners) <= error and _is_near(corners, points, faces, volume, up, error):
            return [corners]
    return decompose(piece.name, points, faces, error, closed)


def _is_near(
    corners: np.ndarray, points: np.ndarray, faces: np.ndarray, volume: float, up: np.ndarray | None, error: float
) -> bool:
    """Returns whether the convex hull of ``corners`` is nowhere farther than ``error`` from a mesh.

    Args:
        corners: points of the hull, ``[K, 3]``, m.
        points: vertices of the mesh, ``[V, 3]``, m.
        faces: its triangles, ``[F, 3]``.
        volume: its volume, m^3.
        up: direction that points up, ``[3]``, if it is open: it may be open below. ``None``: it is closed.
        error: accepted distance, m.
    """
    hull = ConvexHull(corners)
    if up is None and hull.volume <= CONVEX * volume:
        return True
    if up is None and hull.volume > NEARLY_CONVEX * volume:
        return False
    samples, facets = random_points(hull.points, hull.simplices, MAX_SAMPLES // 10)
    far = distances(samples, points, faces, error) > error
    return not far.any() if up is None else bool((hull.equations[facets[far], :3] @ up < -0.9).all())


def _hull(points: np.ndarray) -> ConvexHull | None:
    """Returns the convex hull of points. ``None`` if it is thinner than :data:`FLATTEST`."""
    hull = convex_hull(points) if len(points) > 3 else None
    if hull is None:
        return None
    # The width along the normal of each facet: the least of them is the thickness. Of many facets, some are enough.
    facets = hull.equations[:: len(hull.equations) // 500 + 1]
    heights = facets[:, :3] @ points[hull.vertices].T + facets[:, 3:]
    return hull if -heights.min(1).max() >= FLATTEST else None


def _depth(points: np.ndarray, faces: np.ndarray, outer: np.ndarray) -> float:
    """Returns how deep a surface lies in the convex hull of the points ``outer`` at most, by samples, m."""
    samples = np.concatenate((points, surface_samples(points, faces)))
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
