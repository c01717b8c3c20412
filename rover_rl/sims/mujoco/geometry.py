"""Static geometry of a world as MuJoCo geoms: a plane or a height field, boxes and convex meshes."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from rover_rl.native.mujoco import mujoco
from rover_rl.worlds import Solids, World

GROUND_MARGIN = 3.0
"""Width of the ground for contacts beyond a world's bounds, m."""
BASE_THICKNESS = 1.0
"""Thickness of the ground below its lowest point, m."""
_QUARTER_TURN = (math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5))
"""Rotation by 90 degrees about the vertical, quaternion (w, x, y, z)."""


def add_ground(spec: mujoco.MjSpec, world: World, **options: Any) -> None:
    """Adds the ground, ``"ground"``: an infinite plane if it is flat, else a height field with a margin.

    Outside the terrain, the height of its edge continues, as in :meth:`Terrain.height_at`. ``options`` are further
    attributes of the geom.
    """
    terrain = world.terrain
    if terrain.is_flat:
        height = terrain.heights[0, 0].item()
        _add_geom(spec, mujoco.mjtGeom.mjGEOM_PLANE, name="ground", pos=(0, 0, height), size=(0, 0, 1), **options)
        return
    ends = [
        (
            math.floor((low - GROUND_MARGIN - start) / terrain.cell),
            math.ceil((high + GROUND_MARGIN - start) / terrain.cell),
        )
        for (low, high), start in zip(world.bounds, terrain.origin, strict=True)
    ]
    columns, rows = (np.arange(first, last + 1) for first, last in ends)
    last_row, last_column = (count - 1 for count in terrain.heights.shape)
    heights = terrain.heights.double().numpy()[np.ix_(rows.clip(0, last_row), columns.clip(0, last_column))]
    lowest, rise = heights.min(), max(float(np.ptp(heights)), 1e-3)
    # MuJoCo splits cells along the diagonal (i, j)-(i + 1, j + 1), Terrain along the other one. Rotated by 90 degrees,
    # the diagonals agree: the height field's x axis is the world's y axis, and its y axis the world's negative x axis.
    data = heights.T[::-1]
    width, depth = ((axis[-1] - axis[0]) * terrain.cell for axis in (columns, rows))
    values, size = ((data - lowest) / rise).ravel().tolist(), (depth / 2, width / 2, rise, BASE_THICKNESS)
    spec.add_hfield(name="ground", nrow=data.shape[0], ncol=data.shape[1], size=size, userdata=values)
    x, y = (start + terrain.cell * (k[0] + k[-1]) / 2 for start, k in zip(terrain.origin, (columns, rows), strict=True))
    field = {"name": "ground", "hfieldname": "ground", "pos": (x, y, lowest), "quat": _QUARTER_TURN}
    _add_geom(spec, mujoco.mjtGeom.mjGEOM_HFIELD, **field, **options)


def add_obstacles(spec: mujoco.MjSpec, world: World, **options: Any) -> None:
    """Adds the obstacles: boxes and convex meshes.

    ``options`` are further attributes of the geoms, and their ``body``.
    """
    for index, obstacle in enumerate(world.obstacles):
        frame = _box_frame(obstacle)
        if frame is None:
            _add_mesh(spec, f"obstacle {index}", obstacle.vertices.numpy(), obstacle.faces.numpy(), **options)
            continue
        center, axes, half = frame
        quaternion = np.empty(4)
        mujoco.mju_mat2Quat(quaternion, axes.ravel())
        _add_geom(spec, mujoco.mjtGeom.mjGEOM_BOX, pos=center, quat=quaternion, size=half, **options)


def _add_mesh(spec: mujoco.MjSpec, name: str, vertices: np.ndarray, faces: np.ndarray, **options: Any) -> None:
    # Vertices relative to their center keep their precision, as MuJoCo stores them in single precision.
    center = vertices.mean(0)
    points, triangles = (vertices - center).ravel().tolist(), faces.ravel().tolist()
    inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
    spec.add_mesh(name=name, uservert=points, userface=triangles, inertia=inertia)
    _add_geom(spec, mujoco.mjtGeom.mjGEOM_MESH, meshname=name, pos=center, **options)


def _add_geom(spec: mujoco.MjSpec, kind: mujoco.mjtGeom, body: Any = None, **options: Any) -> None:
    (body or spec.worldbody).add_geom(type=kind, **options)


def _box_frame(obstacle: Solids) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """Returns the center ``[3]``, axes (columns) ``[3, 3]`` and the half extents ``[3]`` of a box, or ``None``."""
    corners, normals = obstacle.vertices.numpy(), obstacle.planes.numpy()[:, :3]
    if len(corners) != 8 or len(normals) != 6:
        return None
    center = corners.mean(0)
    first = normals[0]
    across = [normal for normal in normals if abs(normal @ first) < 1e-9]
    second = next(iter(across), first)
    axes = np.stack((first, second, np.cross(first, second)), 1)
    halves = np.abs((corners - center) @ axes)
    if len(across) != 4 or np.ptp(halves, axis=0).max() > 1e-9:
        return None
    return center, axes, halves.mean(0)
