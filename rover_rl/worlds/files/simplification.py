"""Simplification of triangle meshes: vertices that a surface does not need are merged with their neighbors."""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_array

from rover_rl.worlds.files.triangles import face_normals

MAX_ROUNDS = 200
LEAST_SHARE = 0.002
"""Share of the vertices that a round must remove, or else it is the last one."""
FLIP = 0.3
"""Least cosine of the angle by which a merge may turn a triangle."""


def simplify(vertices: np.ndarray, faces: np.ndarray, error: float) -> tuple[np.ndarray, np.ndarray]:
    """Returns a mesh with fewer triangles by edge collapses (Garland and Heckbert, 1997, doi:10.1145/258734.258849).

    In each round, vertices that are far from one another move to a neighbor at once. A closed mesh stays closed.

    Args:
        vertices: ``[V, 3]``, m.
        faces: ``[F, 3]``.
        error: largest distance of a vertex from the planes of the triangles that it stands for, their root mean square,
            m.
    """
    normals = face_normals(vertices, faces)
    # Weighted by the area, as the length of the normals is twice that.
    planes = np.column_stack((normals, -(normals * vertices[faces[:, 0]]).sum(1)))
    planes /= np.sqrt(np.linalg.norm(normals, axis=1, keepdims=True))
    quadrics = np.zeros((len(vertices), 4, 4))
    np.add.at(quadrics, faces, (planes[:, :, None] * planes[:, None, :])[:, None])
    fixed = np.zeros(len(vertices), dtype=bool)
    edges, counts = np.unique(np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)), axis=0, return_counts=True)
    fixed[edges[counts != 2]] = True
    rng = np.random.default_rng(0)
    for _ in range(MAX_ROUNDS):
        moves = _moves(vertices, faces, quadrics, fixed, error, rng)
        np.add.at(quadrics, moves[:, 1], quadrics[moves[:, 0]])
        target = np.arange(len(vertices))
        target[moves[:, 0]] = moves[:, 1]
        faces = target[faces]
        faces = faces[(faces != np.roll(faces, 1, axis=1)).all(1)]
        if len(moves) <= LEAST_SHARE * len(np.unique(faces)):
            break
    used, renumbered = np.unique(faces, return_inverse=True)
    return vertices[used], renumbered.reshape(-1, 3)


def _moves(
    vertices: np.ndarray,
    faces: np.ndarray,
    quadrics: np.ndarray,
    fixed: np.ndarray,
    error: float,
    rng: np.random.Generator,
) -> np.ndarray:
    """Returns which vertices move to which neighbors: ``[M, 2]``. None of them has a neighbor in common."""
    count = len(vertices)
    start, end = np.concatenate([faces[:, [k, (k + step) % 3]] for k in range(3) for step in (1, 2)]).T
    links = coo_array((np.ones(len(start), dtype=np.int32), (start, end)), shape=(count, count)).tocsr()
    links.data[:] = 1
    # Neighbors in common: with more than two, the surface would touch itself.
    shared = (links @ links).multiply(links).tocoo()
    pairs, common = np.stack(shared.coords, -1), shared.data
    corner = np.column_stack((vertices, np.ones(count)))[pairs[:, 1]]
    costs = (np.einsum("mij,mj->mi", quadrics[pairs[:, 0]], corner) * corner).sum(1)
    costs /= np.trace(quadrics[:, :3, :3], axis1=1, axis2=2)[pairs[:, 0]]
    allowed = (common == 2) & (costs <= error**2) & ~fixed[pairs[:, 0]]
    pairs, costs = pairs[allowed], costs[allowed]
    flips = _flips(vertices, faces, pairs)
    pairs, costs = pairs[~flips], costs[~flips]
    order = np.argsort(costs + 0.01 * error**2 * rng.random(len(costs)))
    # The first move of each vertex, if it comes before those of all vertices up to two edges away.
    _, first = np.unique(pairs[order, 0], return_index=True)
    rank = np.full(count, len(order))
    rank[pairs[order[first], 0]] = first
    best = rank
    for _ in range(2):
        near = best.copy()
        np.minimum.at(near, start, best[end])
        best = near
    return pairs[order[first]][best[pairs[order[first], 0]] == first]


def _flips(vertices: np.ndarray, faces: np.ndarray, pairs: np.ndarray) -> np.ndarray:
    """Returns which moves of a vertex to another one would turn a triangle over, or make it a line: ``[M]``."""
    owner = faces.ravel()
    order = np.argsort(owner, kind="stable")
    starts = np.searchsorted(owner[order], np.arange(len(vertices) + 1))
    counts = (starts[1:] - starts[:-1])[pairs[:, 0]]
    move = np.repeat(np.arange(len(pairs)), counts)
    offset = np.arange(len(move)) - np.repeat(np.cumsum(counts) - counts, counts)
    corners = faces[order[starts[pairs[move, 0]] + offset] // 3]
    moved = np.where(corners == pairs[move, :1], pairs[move, 1:], corners)
    stays = (corners != pairs[move, 1:]).all(1)
    old, new = face_normals(vertices, corners), face_normals(vertices, moved)
    turned = (old * new).sum(1) <= FLIP * np.linalg.norm(old, axis=1) * np.linalg.norm(new, axis=1)
    flips = np.zeros(len(pairs), dtype=bool)
    flips[move[stays & turned]] = True
    return flips
