"""Colored triangle meshes of the ground, the obstacles, the goal, the parts of movers and robots."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
import trimesh
from scipy.spatial.transform import Rotation
from trimesh.graph import smooth_shade

from rover_rl.robots import Robot
from rover_rl.robots.shapes import Frame, Shape
from rover_rl.robots.urdf.description import load_mesh
from rover_rl.sims.rendering import scenery
from rover_rl.sims.rendering.scenery import Look, looks_of
from rover_rl.worlds import Terrain, World
from rover_rl.worlds.movers.mover import KINDS, Kind
from rover_rl.worlds.movers.parts import Parts
from rover_rl.worlds.solids import Solids

SEGMENTS = 48
"""Number of sides of the prisms that stand for cylinders."""
MAX_ANGLE = math.radians(30)
"""Angle between two triangles up to which their common edge is shaded smoothly, rad."""
TINT = 0.04
"""Largest relative difference of the brightness of an obstacle from ``scenery.OBSTACLE``."""
SHOULDERS, HEAD = 0.32, 0.11
"""Height of the shoulders below the top of a person of 1.75 m, and radius of the head, m."""


@dataclass(frozen=True)
class Surface:
    """Triangle mesh: vertices ``[V, 3]`` (m) with unit normals, faces ``[F, 3]``, counter-clockwise from outside.

    Each triangle has a color, 0 to 1, ``[F, 3]``.
    """

    vertices: np.ndarray
    faces: np.ndarray
    normals: np.ndarray
    colors: np.ndarray

    @classmethod
    def join(cls, parts: Sequence[Surface]) -> Surface:
        starts = np.cumsum([0, *(len(part.vertices) for part in parts[:-1])])
        faces = np.concatenate([part.faces + start for part, start in zip(parts, starts, strict=True)])
        vertices, normals, colors = (
            np.concatenate([getattr(part, name) for part in parts]) for name in ("vertices", "normals", "colors")
        )
        return cls(vertices, faces, normals, colors)

    @classmethod
    def of_solid(cls, mesh: trimesh.Trimesh, color: Sequence[float]) -> Surface:
        """Surface of one color that is smooth but for sharp edges."""
        shaded = smooth_shade(mesh, angle=MAX_ANGLE)
        colors = np.tile(color, (len(shaded.faces), 1))
        return cls(np.array(shaded.vertices), np.array(shaded.faces), np.array(shaded.vertex_normals), colors)


def ground_surface(terrain: Terrain, max_cell: float = math.inf) -> Surface:
    """Creates the surface of a terrain. Cells of flat ground that are larger than ``max_cell`` (m) are divided."""
    if terrain.is_flat:
        parts = math.ceil(terrain.cell / min(max_cell, terrain.cell))
        rows, columns = ((count - 1) * parts + 1 for count in terrain.heights.shape)
        terrain = Terrain(terrain.heights[:1, :1].expand(rows, columns), terrain.cell / parts, terrain.origin)
    vertices, faces = terrain.mesh()
    colors = np.tile(scenery.GROUND, (len(faces), 1))
    return Surface(vertices.numpy(), faces.numpy(), _vertex_normals(vertices, faces).numpy(), colors)


def obstacles_surface(world: World) -> Surface | None:
    """Creates the surface of all obstacles of a world, ``None`` if there are none."""
    solids = Solids.of(world.obstacles)
    if not solids:
        return None
    # Separate vertices for every triangle give flat shading with visible edges.
    corners = solids.vertices[solids.faces.flatten()].numpy()
    tints = np.random.default_rng(0).uniform(1 - TINT, 1 + TINT, len(solids))
    counts = [len(shape.faces) for shape in solids.shapes]
    faces = np.arange(len(corners)).reshape(-1, 3)
    normals = _vertex_normals(torch.from_numpy(corners), torch.from_numpy(faces)).numpy()
    return Surface(corners, faces, normals, np.outer(tints.repeat(counts), scenery.OBSTACLE))


@cache
def post_surface() -> Surface:
    """Creates the surface of the post of the goal, whose origin is on the ground."""
    post = trimesh.creation.cylinder(scenery.POST_RADIUS, scenery.POST_LENGTH, sections=SEGMENTS)
    post.apply_translation((0, 0, scenery.POST_LENGTH / 2))
    return Surface.of_solid(post, scenery.GOAL)


class Form(NamedTuple):
    """Kind, length, width and height (m), and look of parts that share a mesh."""

    kind: Kind
    size: tuple[float, float, float]
    look: Look


def forms_of(world: World, parts: Parts) -> list[Form]:
    """Returns the form of each part of one row in a world. Sizes are rounded, so that equal parts share a form."""
    forms, kinds, halves = [], parts.kind[0].tolist(), parts.half[0].tolist()
    for kind, half, look in zip(kinds, halves, looks_of(world, len(kinds)), strict=True):
        length, width, height = (round(2 * one, 4) for one in half)
        forms.append(Form(KINDS[kind], (length, width, height), look))
    return forms


@lru_cache(maxsize=512)
def part_surface(form: Form) -> Surface:
    length, _, height = form.size
    if form.look.is_figure:
        return _figure(length / 2, height, form.look.color)
    # The length of a capsule is that of its cylinder.
    sizes = {"box": form.size, "cylinder": (length / 2, height), "capsule": (length / 2, height - length)}
    return Surface.of_solid(_primitive(form.kind, sizes[form.kind]), form.look.color)


def _figure(radius: float, height: float, color: Sequence[float]) -> Surface:
    """Creates the trunk and the head of a person, within the cylinder that the trunk is for lidar and physics."""
    scale = radius / 0.22
    shoulders, head = height / 2 - SHOULDERS * scale, HEAD * scale
    bend = np.linspace(0, np.pi / 2, 9)
    # A trunk with round edges, and a ball above it.
    hem = np.column_stack((0.8 * radius + 0.2 * radius * np.sin(bend), -height / 2 + 0.1 * (1 - np.cos(bend)) * scale))
    neck = np.column_stack((radius * np.cos(bend), shoulders + 0.09 * scale * np.sin(bend)))
    trunk = trimesh.creation.revolve([(0, -height / 2), *hem, *neck[:-1], (0, neck[-1, 1])], sections=SEGMENTS)
    ball = trimesh.creation.icosphere(subdivisions=3, radius=head)
    ball.apply_translation((0, 0, height / 2 - head))
    return Surface.join([Surface.of_solid(trunk, color), Surface.of_solid(ball, scenery.SKIN)])


def robot_surface(robot: Robot) -> Surface:
    """Creates the surface of a robot in its base frame, with all joint angles at zero.

    Raises ``ValueError`` if a mesh file cannot be read.
    """
    try:
        return Surface.join([part for shape in robot.visuals or _own_shapes(robot) for part in _parts(shape)])
    except ValueError as error:
        raise ValueError(f"robot {robot.name!r} cannot be rendered: {error}") from error


def _own_shapes(robot: Robot) -> list[Shape]:
    """Boxes and wheels of a robot without visual shapes."""
    axle = Rotation.from_rotvec((np.pi / 2, 0, 0)).as_matrix()
    shapes = [Shape("box", Frame(np.array(box.center), np.eye(3)), box.size) for box in robot.boxes]
    kind, sizes = ("cylinder" if robot.wheels.width else "sphere"), (robot.wheels.radius, robot.wheels.width)
    return shapes + [Shape(kind, Frame(np.array(hub), axle), sizes) for hub in robot.wheels.hubs]


def _parts(shape: Shape) -> list[Surface]:
    """Creates the surfaces of a shape. A mesh file may hold several of different colors."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = shape.frame.rotation, shape.frame.position
    meshes = load_mesh(Path(shape.file), shape.sizes) if shape.kind == "mesh" else [_primitive(shape.kind, shape.sizes)]
    return [Surface.of_solid(mesh.apply_transform(matrix), shape.color or _own_color(mesh)) for mesh in meshes]


def _primitive(kind: str, sizes: Sequence[float]) -> trimesh.Trimesh:
    """Creates a box by its sides, a sphere by its radius, or a cylinder or a capsule by radius and length, m."""
    if kind == "box":
        return trimesh.creation.box(sizes)
    if kind == "sphere":
        return trimesh.creation.icosphere(subdivisions=3, radius=sizes[0])
    radius, length = sizes
    if kind == "capsule":
        return trimesh.creation.capsule(length, radius, (SEGMENTS, SEGMENTS // 2))
    return trimesh.creation.cylinder(radius, length, sections=SEGMENTS)


def _own_color(mesh: trimesh.Trimesh) -> tuple[float, ...]:
    """Returns the main color that a mesh file states, or :data:`~rover_rl.sims.rendering.scenery.UNPAINTED`."""
    visual: Any = mesh.visual
    if not visual.defined:
        return scenery.UNPAINTED
    painted = visual.material if visual.kind == "texture" else visual
    return tuple(painted.main_color[:3] / 255)


def _vertex_normals(vertices: torch.Tensor, faces: torch.Tensor) -> torch.Tensor:
    """Returns the means of the normals of the triangles around each vertex, weighted by area, ``[V, 3]``."""
    a, b, c = vertices[faces].unbind(1)
    across = torch.linalg.cross(b - a, c - a)
    sums = torch.zeros_like(vertices).index_add_(0, faces.flatten(), across.repeat_interleave(3, 0))
    return torch.nn.functional.normalize(sums, dim=-1)
