"""Heights of triangle meshes on grid points, seen from below."""

from __future__ import annotations

import numpy as np

CHUNK = 4_000_000
"""Number of pairs of a triangle and a grid point that are tested at once."""
STEEPEST = 0.17
"""Least z component of the unit normal of a face that counts as ground (80 degrees)."""


def surface_heights(
    vertices: np.ndarray, faces: np.ndarray, origin: tuple[float, float], cell: float, shape: tuple[int, int]
) -> np.ndarray:
    """Returns the lowest height of a surface at each point of a grid, by vertical rays through its triangles.

    Args:
        vertices: ``[V, 3]``, m.
        faces: triangles of the surface, without vertical ones, ``[F, 3]``.
        origin: ``(x, y)`` of the first point, m.
        cell: spacing of the points, m.
        shape: number of points along y and x.

    Returns:
        Heights ``[rows, columns]``, m, NaN where there is no triangle.
    """
    heights = np.full(shape[0] * shape[1], np.inf)
    corners = vertices[faces]
    # Grid coordinates: column, row, and height in meters.
    corners = (corners - (*origin, 0.0)) / (cell, cell, 1.0)
    low = np.clip(np.ceil(corners[..., :2].min(1) - 1e-6).astype(int), 0, None)
    high = np.minimum(np.floor(corners[..., :2].max(1) + 1e-6).astype(int), (shape[1] - 1, shape[0] - 1))
    span = np.clip(high - low + 1, 0, None)
    count = span[:, 0] * span[:, 1]
    order = np.flatnonzero(count)
    start = 0
    while start < len(order):
        stop = start + max(1, int(np.searchsorted(np.cumsum(count[order[start:]]), CHUNK)))
        _lower(heights, corners, low, span, count, order[start:stop], shape[1])
        start = stop
    heights[np.isinf(heights)] = np.nan
    return heights.reshape(shape)


def _lower(
    heights: np.ndarray,
    corners: np.ndarray,
    low: np.ndarray,
    span: np.ndarray,
    count: np.ndarray,
    chosen: np.ndarray,
    columns: int,
) -> None:
    """Lowers ``heights`` to the triangles ``chosen``, tested at every grid point of their bounding rectangles."""
    triangle = np.repeat(chosen, count[chosen])
    first = np.repeat(np.cumsum(count[chosen]) - count[chosen], count[chosen])
    place = np.arange(len(triangle)) - first
    column = low[triangle, 0] + place % span[triangle, 0]
    row = low[triangle, 1] + place // span[triangle, 0]
    a, b, c = (corners[triangle, k] for k in range(3))
    # Barycentric coordinates of the point in the triangle's projection.
    area = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (c[:, 0] - a[:, 0]) * (b[:, 1] - a[:, 1])
    x, y = column - a[:, 0], row - a[:, 1]
    with np.errstate(divide="ignore", invalid="ignore"):
        v = (x * (c[:, 1] - a[:, 1]) - (c[:, 0] - a[:, 0]) * y) / area
        w = ((b[:, 0] - a[:, 0]) * y - x * (b[:, 1] - a[:, 1])) / area
        inside = (v >= -1e-6) & (w >= -1e-6) & (v + w <= 1 + 1e-6)
        z = a[:, 2] + v * (b[:, 2] - a[:, 2]) + w * (c[:, 2] - a[:, 2])
    np.minimum.at(heights, (row * columns + column)[inside], z[inside])


def upward_faces(vertices: np.ndarray, faces: np.ndarray, both_sides: bool) -> np.ndarray:
    """Returns the faces that a wheel could stand on, by their normals: ``[K, 3]``.

    Args:
        vertices: ``[V, 3]``, m.
        faces: ``[F, 3]``.
        both_sides: count faces whose normal points down, too: a sheet has no inside.
    """
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    length = np.linalg.norm(normal, axis=1)
    up = np.abs(normal[:, 2]) if both_sides else normal[:, 2]
    return faces[(length > 1e-12) & (up > STEEPEST * length)]


def projected_area(vertices: np.ndarray, faces: np.ndarray) -> float:
    """Returns the sum of the areas of triangles seen from above, m^2."""
    a, b, c = (vertices[faces[:, k], :2] for k in range(3))
    return float(np.abs((b - a)[:, 0] * (c - a)[:, 1] - (c - a)[:, 0] * (b - a)[:, 1]).sum() / 2)
