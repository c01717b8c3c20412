"""Triangle meshes as arrays: ``vertices [V, 3]`` in meters, and ``faces [F, 3]``, counter-clockwise from outside."""

from __future__ import annotations

import numpy as np
from scipy.spatial import ConvexHull, QhullError
from trimesh.graph import connected_components, face_adjacency, is_watertight

from rover_rl.sims.worlds.files.contents import Piece

MERGE = 1e-5
"""Vertices of a mesh that are closer than this are one, m."""
CHUNK = 4_000_000
"""Number of pairs of a triangle and a grid point that are tested at once."""
STEEPEST = 0.17
"""Least z component of the unit normal of a face that counts as ground (80 degrees)."""


def face_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Returns the normals of triangles, twice as long as the triangles are large: ``[F, 3]``."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return np.cross(b - a, c - a)


def split(piece: Piece) -> list[Piece]:
    """Splits a mesh into its connected parts, after merging equal vertices and dropping triangles without area.

    Two triangles are connected if they share an edge with no third one: bodies that touch stay apart.
    """
    if piece.faces is None:
        return [piece]
    _, first, same = np.unique(
        np.rint(piece.vertices / MERGE).astype(np.int64), axis=0, return_index=True, return_inverse=True
    )
    vertices, faces = piece.vertices[first], same.reshape(-1)[piece.faces]
    faces = faces[np.linalg.norm(face_normals(vertices, faces), axis=1) > 1e-12]
    # A triangle that occurs twice with the same corners would hide holes.
    _, keep = np.unique(np.sort(faces, axis=1), axis=0, return_index=True)
    faces = faces[np.sort(keep)]
    return [_part(piece.name, vertices, faces[group]) for group in connected(faces)]


def connected(faces: np.ndarray, normals: np.ndarray | None = None, sine: float = 0.0) -> list[np.ndarray]:
    """Returns groups of triangles that are connected by edges with no third triangle, as indices.

    With unit normals ``[F, 3]``, which may point to either side, triangles only connect if the sine of the angle
    between them is less than ``sine``.
    """
    if not len(faces):
        return []
    pairs = face_adjacency(faces)
    if normals is not None:
        pairs = pairs[np.abs((normals[pairs[:, 0]] * normals[pairs[:, 1]]).sum(1)) > 1 - sine**2]
    return [np.sort(group) for group in connected_components(pairs, min_len=1, nodes=np.arange(len(faces)))]


def _part(name: str, vertices: np.ndarray, faces: np.ndarray) -> Piece:
    used, renumbered = np.unique(faces, return_inverse=True)
    return Piece(name, vertices[used], renumbered.reshape(faces.shape))


def is_closed(faces: np.ndarray) -> bool:
    """Returns whether every edge belongs to two triangles, which run along it in opposite directions."""
    return len(faces) > 0 and all(is_watertight(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)))


def signed_volume(vertices: np.ndarray, faces: np.ndarray) -> float:
    """Returns the volume of a closed mesh, m^3: negative if its normals point inward."""
    a, b, c = (vertices[faces[:, k]] - vertices.mean(0) for k in range(3))
    return float((a * np.cross(b, c)).sum() / 6)


def upward_faces(vertices: np.ndarray, faces: np.ndarray, both_sides: bool) -> np.ndarray:
    """Returns the faces that a wheel could stand on. Those of a sheet count on both sides: it has no inside."""
    normal = face_normals(vertices, faces)
    length = np.linalg.norm(normal, axis=1)
    up = np.abs(normal[:, 2]) if both_sides else normal[:, 2]
    return faces[(length > 1e-12) & (up > STEEPEST * length)]


def surface_heights(
    vertices: np.ndarray, faces: np.ndarray, origin: tuple[float, float], cell: float, shape: tuple[int, int]
) -> np.ndarray:
    """Returns the lowest height of a surface without vertical faces at each point of a grid, by vertical rays.

    Args:
        vertices: ``[V, 3]``, m.
        faces: ``[F, 3]``.
        origin: ``(x, y)`` of the first point, m.
        cell: spacing of the points, m.
        shape: number of points along y and x.

    Returns:
        Heights ``[rows, columns]``, m, NaN where there is no triangle.
    """
    heights = np.full(shape[0] * shape[1], np.inf)
    # Grid coordinates: column, row, and height in meters.
    corners = (vertices[faces] - (*origin, 0.0)) / (cell, cell, 1.0)
    low = np.clip(np.ceil(corners[..., :2].min(1) - 1e-6).astype(int), 0, None)
    high = np.minimum(np.floor(corners[..., :2].max(1) + 1e-6).astype(int), (shape[1] - 1, shape[0] - 1))
    span = np.clip(high - low + 1, 0, None)
    count = span[:, 0] * span[:, 1]
    order = np.flatnonzero(count)
    start = 0
    while start < len(order):
        stop = start + max(1, int(np.searchsorted(np.cumsum(count[order[start:]]), CHUNK)))
        chosen = order[start:stop]
        # Every grid point of the bounding rectangle of every triangle.
        triangle = np.repeat(chosen, count[chosen])
        place = np.arange(len(triangle)) - np.repeat(np.cumsum(count[chosen]) - count[chosen], count[chosen])
        column, row = low[triangle, 0] + place % span[triangle, 0], low[triangle, 1] + place // span[triangle, 0]
        inside, z = _heights_in(corners[triangle], column, row)
        np.minimum.at(heights, (row * shape[1] + column)[inside], z[inside])
        start = stop
    heights[np.isinf(heights)] = np.nan
    return heights.reshape(shape)


def _heights_in(corners: np.ndarray, column: np.ndarray, row: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns which points are in their triangles ``corners [P, 3, 3]`` seen from above, and the heights there."""
    a, b, c = corners.swapaxes(0, 1)
    # Barycentric coordinates of the point in the triangle's projection.
    area = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (c[:, 0] - a[:, 0]) * (b[:, 1] - a[:, 1])
    x, y = column - a[:, 0], row - a[:, 1]
    with np.errstate(divide="ignore", invalid="ignore"):
        v = (x * (c[:, 1] - a[:, 1]) - (c[:, 0] - a[:, 0]) * y) / area
        w = ((b[:, 0] - a[:, 0]) * y - x * (b[:, 1] - a[:, 1])) / area
        inside = (v >= -1e-6) & (w >= -1e-6) & (v + w <= 1 + 1e-6)
        return inside, a[:, 2] + v * (b[:, 2] - a[:, 2]) + w * (c[:, 2] - a[:, 2])


def merge_triangles(points: np.ndarray, triangles: np.ndarray) -> list[list[int]]:
    """Merges triangles ``[T, 3]`` of ``points [P, 2]`` into convex polygons, greedily, as indices of the points.

    Some of the points may lie on the edges of their polygon.
    """
    whole = {*triangles.ravel().tolist()}
    left = {k: ({*triangle}, _area({*triangle}, points)) for k, triangle in enumerate(triangles.tolist())}
    if _area(whole, points) <= sum(area for _, area in left.values()) * (1 + 1e-6):
        return [[*whole]]
    polygons = []
    while left:
        _, (polygon, area) = left.popitem()
        grown = True
        while grown:
            grown = False
            for other, (corners, more) in list(left.items()):
                if len(polygon & corners) >= 2 and _area(polygon | corners, points) <= (area + more) * (1 + 1e-6):
                    polygon, area, grown = polygon | corners, area + more, True
                    del left[other]
        polygons.append([*polygon])
    return polygons


def _area(corners: set[int], points: np.ndarray) -> float:
    """Returns the area of the convex hull of points."""
    try:
        return float(ConvexHull(points[list(corners)]).volume)
    except QhullError:
        return 0.0
