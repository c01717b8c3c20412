"""Colored triangle meshes of the ground, the obstacles and the goal."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
import torch
import trimesh
from trimesh.graph import smooth_shade
from trimesh.remesh import subdivide_to_size

from rover_rl.sims.rendering.scenery import GOAL, GROUND, OBSTACLE, POST_LENGTH, POST_RADIUS
from rover_rl.worlds import Solids, Terrain, World

SEGMENTS = 48
"""Number of sides of the prisms that stand for cylinders."""
MAX_ANGLE = math.radians(30)
"""Angle between two triangles up to which their common edge is shaded smoothly, rad."""
MAX_CELL = 0.25
"""Largest cell of flat ground, m: its vertices hold the shades of corners and shadows."""
MAX_EDGE = 1.0
"""Longest edge of a triangle of an obstacle, m, for the same reason. Rays also find small triangles faster."""
TINT = 0.04
"""Largest relative difference of the brightness of an obstacle from :data:`OBSTACLE`."""


@dataclass(frozen=True)
class Surface:
    """Triangle mesh with smooth normals and colors.

    Attributes:
        vertices: float64 ``[V, 3]``, m.
        faces: triangles as indices of vertices, counter-clockwise from outside, int64 ``[F, 3]``.
        normals: unit normal of each vertex, float64 ``[V, 3]``.
        colors: color of each triangle, 0 to 1, float64 ``[F, 3]``.
    """

    vertices: np.ndarray
    faces: np.ndarray
    normals: np.ndarray
    colors: np.ndarray

    @classmethod
    def join(cls, parts: Sequence[Surface]) -> Surface:
        """Joins surfaces to one."""
        starts = np.cumsum([0, *(len(part.vertices) for part in parts[:-1])])
        return cls(
            np.concatenate([part.vertices for part in parts]),
            np.concatenate([part.faces + start for part, start in zip(parts, starts, strict=True)]),
            np.concatenate([part.normals for part in parts]),
            np.concatenate([part.colors for part in parts]),
        )

    @classmethod
    def of_solid(cls, mesh: trimesh.Trimesh, color: Sequence[float]) -> Surface:
        """Creates a surface of one color that is smooth but for sharp edges."""
        shaded = smooth_shade(mesh, angle=MAX_ANGLE)
        colors = np.tile(color, (len(shaded.faces), 1))
        return cls(np.array(shaded.vertices), np.array(shaded.faces), np.array(shaded.vertex_normals), colors)


def ground_surface(terrain: Terrain, max_cell: float = MAX_CELL) -> Surface:
    """Creates the surface of a terrain. Cells of flat ground that are larger than ``max_cell`` (m) are divided."""
    if terrain.is_flat:
        parts = math.ceil(terrain.cell / min(max_cell, terrain.cell))
        rows, columns = ((count - 1) * parts + 1 for count in terrain.heights.shape)
        terrain = Terrain(terrain.heights[:1, :1].expand(rows, columns), terrain.cell / parts, terrain.origin)
    vertices, faces = terrain.mesh()
    colors = np.tile(GROUND, (len(faces), 1))
    return Surface(vertices.numpy(), faces.numpy(), _vertex_normals(vertices, faces).numpy(), colors)


def obstacles_surface(world: World, max_edge: float = MAX_EDGE) -> Surface | None:
    """Creates the surface of all obstacles of a world, ``None`` if there are none.

    Triangles with an edge longer than ``max_edge`` (m) are divided.
    """
    solids = Solids.of(world.obstacles)
    if not solids:
        return None
    # Separate vertices for every triangle give flat shading with visible edges.
    corners = solids.vertices[solids.faces.flatten()].numpy()
    tints = np.random.default_rng(0).uniform(1 - TINT, 1 + TINT, len(solids))
    counts = [len(shape.faces) for shape in solids.shapes]
    obstacle = np.arange(len(counts)).repeat(counts)
    vertices, faces = corners, np.arange(len(corners)).reshape(-1, 3)
    if max_edge < math.inf:
        vertices, faces, whole = subdivide_to_size(vertices, faces, max_edge, max_iter=30, return_index=True)
        order = obstacle[whole].argsort(kind="stable")
        faces, obstacle = faces[order], obstacle[whole][order]
    normals = _vertex_normals(torch.from_numpy(vertices), torch.from_numpy(faces)).numpy()
    return Surface(vertices, faces, normals, np.outer(tints[obstacle], OBSTACLE))


@cache
def post_surface() -> Surface:
    """Creates the surface of the post of the goal, whose origin is on the ground."""
    post = trimesh.creation.cylinder(POST_RADIUS, POST_LENGTH, sections=SEGMENTS)
    post.apply_translation((0, 0, POST_LENGTH / 2))
    return Surface.of_solid(post, GOAL)


def _vertex_normals(vertices: torch.Tensor, faces: torch.Tensor) -> torch.Tensor:
    """Returns the means of the normals of the triangles around each vertex, weighted by area, ``[V, 3]``."""
    a, b, c = vertices[faces].unbind(1)
    across = torch.linalg.cross(b - a, c - a)
    sums = torch.zeros_like(vertices).index_add_(0, faces.flatten(), across.repeat_interleave(3, 0))
    return torch.nn.functional.normalize(sums, dim=-1)
