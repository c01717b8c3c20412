"""Meshes and convex hulls as Bullet shapes, without PyBullet's memory leak.

``createCollisionShape`` of PyBullet never releases the lists passed to it: neither the lists of vertices and indices,
nor the list ``[x, y, z]`` of each vertex. It does release the numbers. This module therefore reuses the same lists for
all shapes and fills them in place, so that a leaked reference has no cost. Only the empty lists of the largest shape so
far remain in memory (80 bytes per vertex).
"""

from __future__ import annotations

import threading
from typing import Any

import numpy as np

from rover_rl.native.bullet import pybullet
from rover_rl.worlds import Terrain
from rover_rl.worlds.world import Area

MESH_CELLS = 60_000
"""Maximum number of cells in one strip of a terrain mesh. Bullet accepts at most 524,288 indices per mesh."""


def terrain_strips(terrain: Terrain, area: Area) -> list[tuple[slice, slice]]:
    """Splits the part of a terrain that covers an area into strips for one mesh each, which share their borders.

    Returns:
        Rows and columns of each strip.
    """
    rows, columns = terrain.covering(area)
    step = max(1, MESH_CELLS // (columns.stop - columns.start))
    last = rows.stop - 1
    return [(slice(row, min(row + step, last) + 1), columns) for row in range(rows.start, last, step)]


def make_hull(client: int, vertices: np.ndarray) -> int:
    """Creates the convex hull of ``vertices [V, 3]`` (m) as a collision shape. Returns its id."""
    with _LISTS as lists:
        return pybullet.createCollisionShape(
            pybullet.GEOM_MESH, vertices=lists.vertices.fill(vertices), physicsClientId=client
        )


def make_mesh(client: int, vertices: np.ndarray, faces: np.ndarray, *, smooth: bool = False) -> int:
    """Creates a concave triangle mesh as a collision shape.

    Args:
        client: id of the Bullet client.
        vertices: vertices ``[V, 3]``, m.
        faces: triangles as indices into ``vertices``, ``[F, 3]``.
        smooth: correct the normals of contacts at the edges between triangles. Without it, a body that slides over a
            plane of triangles is stopped now and then by an edge in the plane. Rays do not need it.

    Returns:
        Id of the shape.
    """
    with _LISTS as lists:
        return pybullet.createCollisionShape(
            pybullet.GEOM_MESH,
            vertices=lists.vertices.fill(vertices),
            indices=lists.fill_indices(faces),
            flags=pybullet.GEOM_FORCE_CONCAVE_TRIMESH | (pybullet.GEOM_CONCAVE_INTERNAL_EDGE if smooth else 0),
            physicsClientId=client,
        )


class _Points:
    """A reusable list of ``[x, y, z]`` lists."""

    def __init__(self) -> None:
        self._points: list[list[float]] = []
        self._rows: list[list[float]] = []

    def fill(self, points: np.ndarray) -> list[list[float]]:
        """Fills the list with ``points [P, 3]`` and returns it. It is valid until :meth:`clear`."""
        self._rows.extend([] for _ in range(len(points) - len(self._rows)))
        self._points[:] = self._rows[: len(points)]
        # Column by column: a list of each point would wake the garbage collector again and again.
        for row, values in zip(self._points, zip(*points.T.tolist(), strict=True), strict=True):
            row[:] = values
        return self._points

    def clear(self) -> None:
        """Releases the numbers. Keeps the lists."""
        for row in self._points:
            row.clear()
        self._points.clear()


class _ReusedLists:
    """Reusable argument lists for PyBullet. A thread locks them for one shape with the ``with`` statement."""

    def __init__(self) -> None:
        self.vertices = _Points()
        self._indices: list[int] = []
        self._lock = threading.Lock()

    def __enter__(self) -> _ReusedLists:
        self._lock.acquire()
        return self

    def __exit__(self, *exception: Any) -> None:
        self.vertices.clear()
        self._indices.clear()
        self._lock.release()

    def fill_indices(self, faces: np.ndarray) -> list[int]:
        """Fills the list of indices with the triangles ``faces [F, 3]`` and returns it."""
        self._indices[:] = faces.ravel().tolist()
        return self._indices


_LISTS = _ReusedLists()
