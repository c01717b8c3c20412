"""Plates in place of surfaces without a volume."""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import ConvexHull, QhullError

from rover_rl.sims.worlds.files.components import edge_pairs

HALF_THICKNESS = 0.01
"""Distance of both faces of a plate from the surface, m."""
SAME_PLANE = 1e-4
"""Largest difference of the unit normals of neighboring triangles in one plane."""


def plates(vertices: np.ndarray, faces: np.ndarray, most: int) -> list[np.ndarray] | None:
    """Returns convex plates of 2 cm that cover a surface, with the surface in their middle.

    Args:
        vertices: ``[V, 3]``, m.
        faces: ``[F, 3]``.
        most: largest number of plates.

    Returns:
        Points whose convex hulls are the plates, each ``[K, 3]``, m. ``None`` if there would be more than ``most``.
    """
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    normals = np.cross(b - a, c - a)
    normals = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    found: list[np.ndarray] = []
    for group in _coplanar(faces, normals):
        found += _convex_parts(vertices, faces[group], normals[group[0]])
        if len(found) > most:
            return None
    return found


def _coplanar(faces: np.ndarray, normals: np.ndarray) -> list[np.ndarray]:
    """Returns groups of triangles that are connected by edges and lie in one plane, as indices."""
    left, right = edge_pairs(faces)
    # The normals of a sheet may point to either side.
    along = np.abs((normals[left] * normals[right]).sum(1))
    flat = along > 1 - SAME_PLANE**2
    ones = np.ones(int(flat.sum()), dtype=np.int8)
    graph = coo_array((ones, (left[flat], right[flat])), shape=(len(faces),) * 2)
    _, label = connected_components(graph, directed=False)
    order = np.argsort(label, kind="stable")
    return np.split(order, np.flatnonzero(np.diff(label[order])) + 1)


def _convex_parts(vertices: np.ndarray, faces: np.ndarray, normal: np.ndarray) -> list[np.ndarray]:
    """Merges the triangles of a plane into convex polygons, and returns these as plates."""
    first = np.cross(normal, np.eye(3)[np.abs(normal).argmin()])
    first = first / np.linalg.norm(first)
    flat = vertices @ np.stack((first, np.cross(normal, first)), -1)
    return [
        np.concatenate([vertices[list(polygon)] + side * HALF_THICKNESS * normal for side in (-1, 1)])
        for polygon in merge_triangles(flat, faces)
    ]


def merge_triangles(points: np.ndarray, triangles: np.ndarray) -> list[set[int]]:
    """Merges triangles of a plane into convex polygons, greedily.

    Args:
        points: ``[P, 2]``.
        triangles: ``[T, 3]``.

    Returns:
        Indices of the points of each polygon, some of which may lie on its edges.
    """
    whole = _area({*triangles.ravel().tolist()}, points)
    areas = [_area({*triangle}, points) for triangle in triangles.tolist()]
    if whole <= sum(areas) * (1 + 1e-6):
        return [{*triangles.ravel().tolist()}]
    left = {k: {*triangle} for k, triangle in enumerate(triangles.tolist())}
    polygons = []
    while left:
        k, polygon = left.popitem()
        area = areas[k]
        grown = True
        while grown:
            grown = False
            for other, corners in list(left.items()):
                together = area + areas[other]
                if len(polygon & corners) >= 2 and _area(polygon | corners, points) <= together * (1 + 1e-6):
                    polygon, area, grown = polygon | corners, together, True
                    del left[other]
        polygons.append(polygon)
    return polygons


def _area(corners: set[int], points: np.ndarray) -> float:
    """Returns the area of the convex hull of points."""
    try:
        return float(ConvexHull(points[list(corners)]).volume)
    except QhullError:
        return 0.0
