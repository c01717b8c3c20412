"""Convex decomposition of closed meshes, cached on disk."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.spatial import ConvexHull, QhullError, cKDTree

from rover_rl.sims.worlds.cache import content_key, load_arrays, store_arrays
from rover_rl.sims.worlds.files import optional
from rover_rl.sims.worlds.files.triangles import face_normals, signed_volume

VERSION = "1"
"""Changes when the same mesh would give other parts."""
MAX_FACES = 200_000
SAMPLES = 6_000
"""Points with which the error of a decomposition is measured."""
COARSE = 2.5
"""Factor on the accepted error with which the decomposition starts: flat walls come out exact, with few parts."""


def decompose(name: str, vertices: np.ndarray, faces: np.ndarray, error: float, closed: bool) -> list[np.ndarray]:
    """Decomposes a solid into convex parts with CoACD (Wei et al., 2022, doi:10.1145/3528223.3530103).

    Args:
        name: name of the solid, for messages.
        vertices: ``[V, 3]``, m.
        faces: ``[F, 3]``, normals outward.
        error: accepted distance of the parts' surface from the mesh for 99 % of it, m. It is tried, not guaranteed.
        closed: whether the mesh is closed. If not, it is remeshed first.

    Returns:
        Points whose convex hulls are the parts, each ``[K, 3]``, m.
    """
    if len(faces) > MAX_FACES:
        raise ValueError(
            f"{name} is not convex and has {len(faces):,} triangles; simplify it to {MAX_FACES:,} or fewer"
        )
    coacd = optional("coacd")
    key = content_key(VERSION, vertices.astype("<f8").tobytes(), faces.astype("<i8").tobytes(), repr((error, closed)))
    stored = load_arrays("convex_parts", key)
    if stored is not None and {"points", "ends"} <= set(stored):
        return np.split(stored["points"], stored["ends"][:-1])
    coacd.set_log_level("off")
    parts = _attempt(coacd, vertices, faces, COARSE * error, closed)
    if closed and _error(vertices, faces, parts) > error:
        parts = _attempt(coacd, vertices, faces, error, closed) or parts
    if not parts:
        raise ValueError(f"{name} cannot be decomposed into convex parts; close its holes and self-intersections")
    store_arrays("convex_parts", key, {"points": np.concatenate(parts), "ends": np.cumsum([len(p) for p in parts])})
    return parts


def _attempt(coacd: Any, vertices: np.ndarray, faces: np.ndarray, threshold: float, closed: bool) -> list[np.ndarray]:
    """Runs CoACD. If the parts do not have about the volume of the mesh, it is remeshed and decomposed again."""
    mesh, volume = coacd.Mesh(vertices, faces), signed_volume(vertices, faces)
    for preprocess in ("off", "on") if closed else ("on",):
        # Fewer search steps than the default take a third of the time, for some more parts.
        found = coacd.run_coacd(
            mesh,
            threshold=threshold,
            real_metric=True,
            preprocess_mode=preprocess,
            preprocess_resolution=100,
            mcts_iterations=30,
            mcts_max_depth=2,
            resolution=1000,
            seed=0,
        )
        parts = [part for part in (np.asarray(points, dtype=float) for points, _ in found) if _volume(part) > 1e-9]
        if preprocess == "on" or 0.9 * volume <= sum(map(_volume, parts)) <= 1.5 * volume:
            return parts
    return []


def _volume(points: np.ndarray) -> float:
    try:
        return float(ConvexHull(points).volume)
    except (QhullError, ValueError):
        return 0.0


def _error(vertices: np.ndarray, faces: np.ndarray, parts: list[np.ndarray]) -> float:
    """Returns the distance of the parts' outer surface from the mesh, the 99th percentile of samples, m."""
    if not parts:
        return float("inf")
    rng = np.random.default_rng(0)
    hulls = [ConvexHull(part) for part in parts]
    outer = []
    for hull in hulls:
        points = _surface_points(hull.points, hull.simplices, max(50, SAMPLES // len(hulls)), rng)
        hidden = np.zeros(len(points), dtype=bool)
        for other in hulls:
            if other is not hull:
                near = (points >= other.min_bound - 1e-3).all(1) & (points <= other.max_bound + 1e-3).all(1) & ~hidden
                planes = other.equations
                hidden[near] |= (points[near] @ planes[:, :3].T + planes[:, 3] <= 1e-3).all(1)
        outer.append(points[~hidden])
    mesh = _surface_points(vertices, faces, 10 * SAMPLES, rng)
    distance, _ = cKDTree(mesh).query(np.concatenate(outer))
    # The nearest sample of the mesh is about this far even from a point of its surface.
    spacing, _ = cKDTree(mesh[::2]).query(mesh[1::2])
    return max(0.0, float(np.quantile(distance, 0.99)) - float(np.quantile(spacing, 0.99)))


def _surface_points(vertices: np.ndarray, faces: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    """Samples points on triangles, in proportion to their areas: ``[count, 3]``."""
    area = np.linalg.norm(face_normals(vertices, faces), axis=1)
    chosen = rng.choice(len(faces), count, p=area / area.sum())
    u, v = rng.random((2, count, 1))
    over = u + v > 1
    u, v = np.where(over, 1 - u, u), np.where(over, 1 - v, v)
    a, b, c = (vertices[faces[chosen, k]] for k in range(3))
    return a + u * (b - a) + v * (c - a)
