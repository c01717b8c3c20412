"""Convex parts of meshes with flat faces: prisms, and plates along the faces."""

from __future__ import annotations

import numpy as np

from rover_rl.worlds.files.triangles import convex_hull, face_normals, flat_patches, merge_triangles, surface_samples

MAX_PARTS = 400
"""Largest number of prisms or plates that replace a mesh."""
HALF_THICKNESS = 0.01
"""Distance of both faces of a plate from an open surface, m."""
SAME_PLANE = 1e-4
"""Largest difference of the unit normals of neighboring triangles in one plane."""
MAX_CAP = 2000
"""Largest number of triangles of the outline of a prism that are merged."""
SEEN = 20
"""Largest number of points of a face from which the thickness behind it is measured."""


def prisms_of(points: np.ndarray, faces: np.ndarray, volume: float, slack: float) -> list[np.ndarray] | None:
    """Returns the points of convex prisms that replace a prism with any outline. ``None`` if the mesh is no prism.

    Args:
        points: ``[V, 3]``, m.
        faces: ``[F, 3]``, normals outward.
        volume: volume of the mesh, m^3.
        slack: largest depth of notches of the outline that are filled, m.
    """
    normals = face_normals(points, faces)
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
            polygons = merge_triangles(_flattened(points, axis), faces[cap], slack)
            found = [np.concatenate([base[each] + height * axis for height in (low, high)]) for each in polygons]
            return found if len(found) <= MAX_PARTS else None
    return None


def plates_of(points: np.ndarray, faces: np.ndarray) -> list[np.ndarray] | None:
    """Returns the points of convex plates with a surface in their middle. ``None`` if there would be too many."""
    found: list[np.ndarray] = []
    for group in flat_patches(points, faces, SAME_PLANE, MAX_PARTS):
        normal = _normal(points, faces[group])
        for polygon in merge_triangles(_flattened(points, normal), faces[group]):
            found.append(np.concatenate([points[polygon] + side * HALF_THICKNESS * normal for side in (-1, 1)]))
        if len(found) > MAX_PARTS:
            return None
    return found or None


def shells_of(points: np.ndarray, faces: np.ndarray) -> list[np.ndarray] | None:
    """Returns the points of convex plates that extend from the faces of a closed mesh as far inward as it is thick.

    The largest face comes first. What the plates of others hold gets none. ``None`` if there would be too many.
    """
    found: list[np.ndarray] = []
    planes: list[np.ndarray] = []
    for group in flat_patches(points, faces, SAME_PLANE, MAX_PARTS):
        normal = _normal(points, faces[group])
        samples = surface_samples(points, faces[group])
        if _held(samples, planes):
            continue
        depth = _depth(samples[:: -(-len(samples) // SEEN)], normal, points[faces])
        flat = _flattened(points, normal)
        for polygon in merge_triangles(flat, faces[group]):
            part = np.concatenate((points[polygon], points[polygon] - depth * normal))
            hull = convex_hull(part) if np.isfinite(depth) else None
            if hull is not None:
                found.append(part)
                planes.append(hull.equations)
        if len(found) > MAX_PARTS:
            return None
    return found or None


def _held(samples: np.ndarray, solids: list[np.ndarray]) -> bool:
    """Returns whether each of some points is in a solid, by its half-spaces."""
    outside = np.ones(len(samples), dtype=bool)
    for planes in solids:
        outside[outside] = (samples[outside] @ planes[:, :3].T + planes[:, 3]).max(1) > 1e-4
    return not outside.any()


def _depth(samples: np.ndarray, normal: np.ndarray, triangles: np.ndarray) -> float:
    """Returns the least distance to the triangles ``[F, 3, 3]`` behind points of a face, against its normal."""
    a, b, c = triangles.swapaxes(0, 1)
    side, other = b - a, c - a
    across = np.cross(-normal, other)
    scale = (side * across).sum(1)
    with np.errstate(divide="ignore", invalid="ignore"):
        offset = samples[:, None] - a
        u = (offset * across).sum(-1) / scale
        turned = np.cross(offset, side)
        v = -(turned @ normal) / scale
        depth = (turned * other).sum(-1) / scale
        hit = (u >= 0) & (v >= 0) & (u + v <= 1) & (depth > 1e-6)
    return float(depth[hit].min(initial=np.inf))


def _normal(points: np.ndarray, faces: np.ndarray) -> np.ndarray:
    normal = face_normals(points, faces[:1])[0]
    return normal / np.linalg.norm(normal)


def _flattened(points: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Returns the coordinates of points in a plane, by its unit normal: ``[P, 2]``."""
    first = np.cross(normal, np.eye(3)[np.abs(normal).argmin()])
    first = first / np.linalg.norm(first)
    return points @ np.stack((first, np.cross(normal, first)), -1)
