"""Convex solids in place of the solids and surfaces of a file: hulls, prisms, plates, and CoACD, cached on disk."""

from __future__ import annotations

import numpy as np
from scipy.spatial import ConvexHull

from rover_rl.worlds.cache import content_key, load_arrays, store_arrays
from rover_rl.worlds.files import triangles as tri
from rover_rl.worlds.files.contents import Piece
from rover_rl.worlds.files.options import optional
from rover_rl.worlds.solids import Solids, even_directions, hull

VERSION = "4"
"""Changes when the same mesh would give other parts."""
FEW_VERTICES = 256
"""Number of vertices of a convex solid up to which all are kept."""
MAX_SAMPLES = 50_000
"""Largest number of points of a surface that are compared with its convex hull."""
THINNEST, FLATTEST = 0.0005, 1e-6
"""Thickness below which a solid is a sheet, and points have no volume, m."""
CONVEX, NEARLY_CONVEX = 1.001, 1.5
"""Largest volume of the convex hull of a convex solid, and of one that is replaced by it, by that of the solid."""
MAX_FACES = 200_000
TINY = 1e-10
"""Volume up to which a part is left out, m^3."""
FEW_PLATES = 64
"""Number of plates up to which they are preferred to CoACD, which takes seconds."""
FEW_FACES = 400
"""Number of triangles up to which a mesh is not simplified."""
FIT_SAMPLES = 6_000
"""Points with which the error of a decomposition is measured."""
COARSE = 2.5
"""Factor on the accepted error with which the decomposition starts: flat walls come out exact, with few parts."""
COARSER = (1, 2, 4, 8)
"""Factors on the accepted error with which an open surface of many faces, such as a dome, is simplified."""
MAX_PARTS = 400
"""Largest number of prisms or plates that replace a mesh."""
HALF_THICKNESS = 0.01
"""Half the thickness of a plate from an open surface, m."""
SAME_PLANE = 1e-4
"""Largest difference of the unit normals of neighboring triangles in one plane."""
MAX_CAP = 2000
"""Largest number of triangles of the outline of a prism that are merged."""


def obstacles_of(piece: Piece, error: float) -> list[Solids]:
    """Returns convex solids in place of a connected piece.

    A convex piece, or one that differs from its convex hull by at most ``error`` (m), becomes its hull. All others are
    decomposed. An open surface, or a sheet with two sides, becomes plates of 2 cm, with the surface in the middle.

    Raises:
        ValueError: if the piece has no volume and no surface, or cannot be decomposed.
    """
    turn, place = piece.pose[:3, :3], piece.pose[:3, 3]
    return [hull(part @ turn.T + place) for part in _convex_parts(piece, error)]


def _convex_parts(piece: Piece, error: float) -> list[np.ndarray]:
    """Returns points whose convex hulls replace a piece, each ``[K, 3]``, m, in the frame of the piece."""
    points, faces = piece.points, piece.faces
    whole = _thick_hull(points)
    if faces is None:
        if whole is None:
            raise ValueError(f"{piece.name} has no volume")
        return [_few_corners(points[whole.vertices], error / 4)]
    closed = tri.is_closed(faces)
    volume = tri.signed_volume(points, faces) if closed else 0.0
    if closed and 4 * abs(volume) <= THINNEST * np.linalg.norm(tri.face_normals(points, faces), axis=1).sum():
        closed = False
    elif volume < 0:
        faces, volume = faces[:, ::-1], -volume
    if whole is not None and (closed or _faces_outward(points, faces, whole)):
        corners = _few_corners(points[whole.vertices], error / 4)
        up = None if closed else piece.pose[2, :3]
        if _depth(points, faces, corners) <= error and _is_near(corners, points, faces, volume, up, error):
            return [corners]
    return _decompose(piece.name, points, faces, error, closed)


def _thick_hull(points: np.ndarray) -> ConvexHull | None:
    hull = tri.convex_hull(points) if len(points) > 3 else None
    if hull is None:
        return None
    # The width along the normal of each facet: the least of them is the thickness. Of many facets, some are enough.
    facets = hull.equations[:: len(hull.equations) // 500 + 1]
    heights = facets[:, :3] @ points[hull.vertices].T + facets[:, 3:]
    return hull if -heights.min(1).max() >= FLATTEST else None


def _few_corners(corners: np.ndarray, error: float) -> np.ndarray:
    count = FEW_VERTICES
    while len(corners) > count:
        chosen = corners[np.unique((corners @ even_directions(count).T).argmax(0))]
        hull = _thick_hull(chosen)
        if hull is not None and (corners @ hull.equations[:, :3].T + hull.equations[:, 3]).max() <= error:
            return chosen
        count *= 2
    return corners


def _faces_outward(points: np.ndarray, faces: np.ndarray, hull: ConvexHull) -> bool:
    outward = points[faces].mean(1) - points[hull.vertices].mean(0)
    return float((outward * tri.face_normals(points, faces)).sum()) > 0


def _depth(points: np.ndarray, faces: np.ndarray, outer: np.ndarray) -> float:
    """Returns how deep a surface lies in the convex hull of the points ``outer`` at most, by samples, m."""
    samples = np.concatenate((points, tri.surface_samples(points, faces)))
    samples = samples[:: -(-len(samples) // MAX_SAMPLES)]
    planes = np.unique(ConvexHull(outer).equations.round(9), axis=0)
    step = max(1, 20_000_000 // len(planes))
    parts = (samples[k : k + step] for k in range(0, len(samples), step))
    return max(float((-(part @ planes[:, :3].T + planes[:, 3])).min(1).max()) for part in parts)


def _is_near(
    corners: np.ndarray, points: np.ndarray, faces: np.ndarray, volume: float, up: np.ndarray | None, error: float
) -> bool:
    """Returns whether the convex hull of ``corners`` is nowhere farther than ``error`` from a mesh.

    ``up`` is the direction that points up, if the mesh is open: it may be open below. ``None``: it is closed.
    """
    hull = ConvexHull(corners)
    if up is None and not CONVEX < hull.volume / volume <= NEARLY_CONVEX:
        return bool(hull.volume <= CONVEX * volume)
    samples, facets = tri.random_points(hull.points, hull.simplices, MAX_SAMPLES // 10)
    far = tri.distances(samples, points, faces) > error
    return not far.any() if up is None else bool((hull.equations[facets[far], :3] @ up < -0.9).all())


def _decompose(name: str, vertices: np.ndarray, faces: np.ndarray, error: float, closed: bool) -> list[np.ndarray]:
    key = content_key(VERSION, vertices.astype("<f8").tobytes(), faces.astype("<i8").tobytes(), repr((error, closed)))
    stored = load_arrays("convex_parts", key)
    if stored is not None and {"points", "ends"} <= set(stored):
        return np.split(stored["points"], stored["ends"][:-1])
    if len(faces) > MAX_FACES:
        raise ValueError(
            f"{name} is not convex and has {len(faces):,} triangles; simplify it to {MAX_FACES:,} or fewer"
        )
    parts = [part for part in _parts(vertices, faces, error, closed) if tri.hull_volume(part) > TINY]
    if not parts:
        raise ValueError(f"{name} cannot be decomposed into convex parts; close its holes and self-intersections")
    store_arrays("convex_parts", key, {"points": np.concatenate(parts), "ends": np.cumsum([len(p) for p in parts])})
    return parts


def _parts(vertices: np.ndarray, faces: np.ndarray, error: float, closed: bool) -> list[np.ndarray]:
    """Decomposes a mesh into convex parts, whose surface is within ``error`` of the mesh for 99 % of it, if possible.

    A closed mesh with flat faces becomes exact prisms or plates, and another one is decomposed with CoACD (Wei et al.,
    2022, doi:10.1145/3528223.3530103). An open one becomes plates, or is closed by remeshing. Meshes with many
    triangles are simplified first.
    """
    volume = tri.signed_volume(vertices, faces) if closed else 0.0
    exact = _prisms_of(vertices, faces, volume, error / 4) if closed else None
    if exact is not None:
        return exact
    points, triangles = vertices, faces
    thickness = 4 * volume / np.linalg.norm(tri.face_normals(vertices, faces), axis=1).sum() if closed else error
    if len(faces) > FEW_FACES:
        points, triangles = tri.simplify(vertices, faces, min(error, thickness) / 4)
    plates = _shells_of(points, triangles) if closed else _plates_of(points, triangles)
    for coarser in () if closed else COARSER:
        if plates is None:
            plates = _plates_of(*tri.simplify(vertices, faces, coarser * error))
    if plates is not None and closed and not _fits(vertices, faces, plates, volume, error):
        plates = None
    if plates is not None and (len(plates) <= FEW_PLATES or thickness <= 2 * error):
        return plates
    parts: list[np.ndarray] = []
    for factor in (COARSE, 1.0) if closed else ():
        parts = _attempt(points, triangles, factor * error, remesh=False)
        if _fits(vertices, faces, parts, volume, error):
            return parts
        if plates is not None:
            return plates
    if sum(map(tri.hull_volume, parts)) <= 0.9 * volume:
        parts = _attempt(points, triangles, COARSE * error, remesh=True)
    return parts


def _attempt(vertices: np.ndarray, faces: np.ndarray, threshold: float, remesh: bool) -> list[np.ndarray]:
    coacd = optional("coacd")
    coacd.set_log_level("off")
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
    hulls = [found for found in map(tri.convex_hull, parts) if found is not None]
    if not 0.9 * volume <= sum(found.volume for found in hulls) <= 1.5 * volume:
        return False
    low, high = (np.array([getattr(found, bound) for found in hulls]) for bound in ("min_bound", "max_bound"))
    outer = []
    for index, own in enumerate(hulls):
        points, _ = tri.random_points(own.points, own.simplices, max(50, FIT_SAMPLES // len(hulls)))
        hidden = np.zeros(len(points), dtype=bool)
        for other in np.flatnonzero(((low <= own.max_bound + 1e-3) & (high >= own.min_bound - 1e-3)).all(1)):
            if other != index:
                planes = hulls[other].equations
                hidden[~hidden] = (points[~hidden] @ planes[:, :3].T + planes[:, 3] <= 1e-3).all(1)
        outer.append(points[~hidden])
    return float(np.quantile(tri.distances(np.concatenate(outer), vertices, faces), 0.99)) <= error


def _prisms_of(points: np.ndarray, faces: np.ndarray, volume: float, slack: float) -> list[np.ndarray] | None:
    """Returns the points of convex prisms that replace a prism with any outline. ``None`` if the mesh is no prism.

    Notches of the outline that are at most ``slack`` (m) deep are filled.
    """
    normals = tri.face_normals(points, faces)
    areas = np.linalg.norm(normals, axis=1)
    normals = normals / areas[:, None]
    first = normals[areas.argmax()]
    # The normal that differs most: the axis is one of both, or normal to both.
    second = normals[np.abs(normals @ first).argmin()]
    across = np.cross(first, second)
    for axis in (first, second, across / max(np.linalg.norm(across), 1e-9)):
        heights = points @ axis
        low, high = heights.min(), heights.max()
        along = normals @ axis
        cap, sides = along > 1 - 1e-6, np.abs(along[np.abs(along) < 0.999])
        is_prism = np.minimum(heights - low, high - heights).max() <= 1e-4 and sides.max(initial=0.0) < 1e-3
        if is_prism and cap.sum() <= MAX_CAP and np.isclose(areas[cap].sum() / 2 * (high - low), volume, rtol=1e-3):
            base = points - np.outer(heights, axis)
            polygons = tri.merge_triangles(_flattened(points, axis), faces[cap], slack)
            found = [np.concatenate([base[each] + height * axis for height in (low, high)]) for each in polygons]
            return found if len(found) <= MAX_PARTS else None
    return None


def _plates_of(points: np.ndarray, faces: np.ndarray) -> list[np.ndarray] | None:
    """Returns the points of convex plates with a surface in their middle. ``None`` if there would be too many."""
    found: list[np.ndarray] = []
    for group in tri.flat_patches(points, faces, SAME_PLANE, MAX_PARTS):
        normal = _normal(points, faces[group])
        for polygon in tri.merge_triangles(_flattened(points, normal), faces[group]):
            found.append(np.concatenate([points[polygon] + side * HALF_THICKNESS * normal for side in (-1, 1)]))
        if len(found) > MAX_PARTS:
            return None
    return found or None


def _shells_of(points: np.ndarray, faces: np.ndarray) -> list[np.ndarray] | None:
    """Returns the points of convex plates that extend from the faces of a closed mesh as far inward as it is thick.

    The largest face comes first. What the plates of others hold gets none. ``None`` if there would be too many.
    """
    found: list[np.ndarray] = []
    planes: list[np.ndarray] = []
    for group in tri.flat_patches(points, faces, SAME_PLANE, MAX_PARTS):
        normal = _normal(points, faces[group])
        samples = tri.surface_samples(points, faces[group])
        outside = np.ones(len(samples), dtype=bool)
        for solid in planes:
            outside[outside] = (samples[outside] @ solid[:, :3].T + solid[:, 3]).max(1) > 1e-4
        if not outside.any():
            continue
        # Not from the face itself, which a ray would meet.
        behind = tri.ray_distances(samples - THINNEST / 2 * normal, -normal, points, faces)
        depth = np.nanmin(behind, initial=np.inf) + THINNEST / 2
        for polygon in tri.merge_triangles(_flattened(points, normal), faces[group]):
            part = np.concatenate((points[polygon], points[polygon] - depth * normal))
            hull = tri.convex_hull(part) if np.isfinite(depth) else None
            if hull is not None:
                found.append(part)
                planes.append(hull.equations)
        if len(found) > MAX_PARTS:
            return None
    return found or None


def _normal(points: np.ndarray, faces: np.ndarray) -> np.ndarray:
    normal = tri.face_normals(points, faces[:1])[0]
    return normal / np.linalg.norm(normal)


def _flattened(points: np.ndarray, normal: np.ndarray) -> np.ndarray:
    first = np.cross(normal, np.eye(3)[np.abs(normal).argmin()])
    first = first / np.linalg.norm(first)
    return points @ np.stack((first, np.cross(normal, first)), -1)
