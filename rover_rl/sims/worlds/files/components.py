"""Connected parts of meshes."""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from rover_rl.sims.worlds.files.contents import Piece

MERGE = 1e-5
"""Vertices of a mesh that are closer than this are one, m."""


def split(piece: Piece) -> list[Piece]:
    """Splits a mesh into its connected parts, after merging equal vertices and dropping triangles without area.

    Two triangles are connected if they share an edge with no third one: bodies that touch stay apart.

    Returns:
        The parts. A convex piece without faces is returned as it is.
    """
    if piece.faces is None:
        return [piece]
    _, first, same = np.unique(
        np.rint(piece.vertices / MERGE).astype(np.int64), axis=0, return_index=True, return_inverse=True
    )
    vertices, faces = piece.vertices[first], same.reshape(-1)[piece.faces]
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    faces = faces[np.linalg.norm(np.cross(b - a, c - a), axis=1) > 1e-12]
    # A triangle that occurs twice with the same corners would hide holes.
    _, keep = np.unique(np.sort(faces, axis=1), axis=0, return_index=True)
    faces = faces[np.sort(keep)]
    if not len(faces):
        return []
    left, right = edge_pairs(faces)
    graph = coo_array((np.ones(len(left), dtype=np.int8), (left, right)), shape=(len(faces),) * 2)
    _, of_face = connected_components(graph, directed=False)
    order = np.argsort(of_face, kind="stable")
    groups = np.split(faces[order], np.flatnonzero(np.diff(of_face[order])) + 1)
    return [_part(piece.name, vertices, group) for group in groups]


def edge_pairs(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns the pairs of triangles that share an edge with no third triangle, as indices: ``[P]`` and ``[P]``."""
    edges = np.sort(np.concatenate((faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]])), axis=1)
    owner = np.tile(np.arange(len(faces)), 3)
    _, of_edge, count = np.unique(edges, axis=0, return_inverse=True, return_counts=True)
    of_edge = of_edge.reshape(-1)
    shared = np.flatnonzero(count[of_edge] == 2)
    order = shared[np.argsort(of_edge[shared], kind="stable")]
    return owner[order[::2]], owner[order[1::2]]


def _part(name: str, vertices: np.ndarray, faces: np.ndarray) -> Piece:
    used, renumbered = np.unique(faces, return_inverse=True)
    return Piece(name, vertices[used], renumbered.reshape(faces.shape))


def is_closed(faces: np.ndarray) -> bool:
    """Returns whether every edge belongs to two triangles, which run along it in opposite directions."""
    edges = np.concatenate((faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]))
    forward = {*map(tuple, edges.tolist())}
    return len(forward) == len(edges) and all((b, a) in forward for a, b in forward)


def signed_volume(vertices: np.ndarray, faces: np.ndarray) -> float:
    """Returns the volume of a closed mesh, m^3: negative if its normals point inward."""
    origin = vertices.mean(0)
    a, b, c = (vertices[faces[:, k]] - origin for k in range(3))
    return float((a * np.cross(b, c)).sum() / 6)
