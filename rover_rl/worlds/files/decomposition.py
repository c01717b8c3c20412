"""Convex decomposition of meshes, cached on disk."""

from __future__ import annotations

from typing import Any

import numpy as np

from rover_rl.worlds.cache import content_key, load_arrays, store_arrays
from rover_rl.worlds.files import optional
from rover_rl.worlds.files.plates import plates_of, prisms_of, shells_of
from rover_rl.worlds.files.simplification import simplify
from rover_rl.worlds.files.triangles import (
    convex_hull,
    distances,
    face_normals,
    random_points,
    signed_volume,
    volume_of,
)

VERSION = "3"
"""Changes when the same mesh would give other parts."""
MAX_FACES = 200_000
TINY = 1e-10
"""Volume up to which a part is left out, m^3."""
FEW_PLATES = 64
"""Number of plates up to which they are preferred to CoACD, which takes seconds."""
FEW_FACES = 400
"""Number of triangles up to which a mesh is not simplified."""
SAMPLES = 6_000
"""Points with which the error of a decomposition is measured."""
COARSE = 2.5
"""Factor on the accepted error with which the decomposition starts: flat walls come out exact, with few parts."""
COARSER = (1, 2, 4, 8)
"""Factors on the accepted error with which an open surface of many faces, such as a dome, is simplified."""


def decompose(name: str, vertices: np.ndarray, faces: np.ndarray, error: float, closed: bool) -> list[np.ndarray]:
    """Decomposes a mesh into convex parts.

    A closed mesh with flat faces becomes exact prisms or plates, and another one is decomposed with CoACD (Wei et al.,
    2022, doi:10.1145/3528223.3530103). An open one becomes plates, or is closed by remeshing. Meshes with many
    triangles are simplified first.

    Args:
        name: name of the mesh, for messages.
        vertices: ``[V, 3]``, m.
        faces: ``[F, 3]``, normals outward.
        error: accepted distance of the parts' surface from the mesh for 99 % of it, m. It is tried, not guaranteed.
        closed: whether the mesh is closed.

    Returns:
        Points whose convex hulls are the parts, each ``[K, 3]``, m.
    """
    key = content_key(VERSION, vertices.astype("<f8").tobytes(), faces.astype("<i8").tobytes(), repr((error, closed)))
    stored = load_arrays("convex_parts", key)
    if stored is not None and {"points", "ends"} <= set(stored):
        return np.split(stored["points"], stored["ends"][:-1])
    if len(faces) > MAX_FACES:
        raise ValueError(
            f"{name} is not convex and has {len(faces):,} triangles; simplify it to {MAX_FACES:,} or fewer"
        )
    parts = [part for part in _parts(vertices, faces, error, closed) if volume_of(convex_hull(part)) > TINY]
    if not parts:
        raise ValueError(f"{name} cannot be decomposed into convex parts; close its holes and self-intersections")
    store_arrays("convex_parts", key, {"points": np.concatenate(parts), "ends": np.cumsum([len(p) for p in parts])})
    return parts


def _parts(vertices: np.ndarray, faces: np.ndarray, error: float, closed: bool) -> list[np.ndarray]:
    volume = signed_volume(vertices, faces) if closed else 0.0
    exact = prisms_of(vertices, faces, volume, error / 4) if closed else None
    if exact is not None:
        return exact
    points, triangles = vertices, faces
    thickness = 4 * volume / np.linalg.norm(face_normals(vertices, faces), axis=1).sum() if closed else error
    if len(faces) > FEW_FACES:
        points, triangles = simplify(vertices, faces, min(error, thickness) / 4)
    plates = shells_of(points, triangles) if closed else plates_of(points, triangles)
    for coarser in () if closed else COARSER:
        if plates is None:
            plates = plates_of(*simplify(vertices, faces, coarser * error))
    if plates is not None and closed and not _fits(vertices, faces, plates, volume, error):
        plates = None
    if plates is not None and (len(plates) <= FEW_PLATES or thickness <= 2 * error):
        return plates
    coacd = optional("coacd")
    coacd.set_log_level("off")
    parts: list[np.ndarray] = []
    for factor in (COARSE, 1.0) if closed else ():
        parts = _attempt(coacd, points, triangles, factor * error, remesh=False)
        if _fits(vertices, faces, parts, volume, error):
            return parts
        if plates is not None:
            return plates
    if sum(volume_of(convex_hull(part)) for part in parts) <= 0.9 * volume:
        parts = _attempt(coacd, points, triangles, COARSE * error, remesh=True)
    return parts


def _attempt(coacd: Any, vertices: np.ndarray, faces: np.ndarray, threshold: float, remesh: bool) -> list[np.ndarray]:
    """Runs CoACD."""
    # Fewer search steps than the default take a third of the time, for some more parts.
    found = coacd.run_coacd(
        coacd.Mesh(vertices, faces),
        threshold=threshold,
        real_metric=True,
        preprocess_mode="on" if remesh else "off",
        preprocess_resolution=100,
        mcts_iterations=30,
        mcts_max_depth=2,
        resolution=1000,
        seed=0,
    )
    return [np.asarray(points, dtype=float) for points, _ in found]


def _fits(vertices: np.ndarray, faces: np.ndarray, parts: list[np.ndarray], volume: float, error: float) -> bool:
    """Returns whether parts have about the volume of a mesh, and 99 % of their outer surface is within the error."""
    hulls = [hull for hull in map(convex_hull, parts) if hull is not None]
    if not 0.9 * volume <= sum(hull.volume for hull in hulls) <= 1.5 * volume:
        return False
    low, high = (np.array([getattr(hull, bound) for hull in hulls]) for bound in ("min_bound", "max_bound"))
    outer = []
    for index, hull in enumerate(hulls):
        points, _ = random_points(hull.points, hull.simplices, max(50, SAMPLES // len(hulls)))
        hidden = np.zeros(len(points), dtype=bool)
        for other in np.flatnonzero(((low <= hull.max_bound + 1e-3) & (high >= hull.min_bound - 1e-3)).all(1)):
            if other != index:
                planes = hulls[other].equations
                hidden[~hidden] = (points[~hidden] @ planes[:, :3].T + planes[:, 3] <= 1e-3).all(1)
        outer.append(points[~hidden])
    return float(np.quantile(distances(np.concatenate(outer), vertices, faces, error), 0.99)) <= error
