"""Surface of a robot: the visual shapes of its URDF, with all joint angles at zero."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from rover_rl.robots import Robot
from rover_rl.robots.description import Description, Frame, Shape
from rover_rl.robots.meshes import find_mesh, load_mesh
from rover_rl.sims.rendering.scenery import UNPAINTED
from rover_rl.sims.rendering.surfaces import SEGMENTS, Surface


def robot_surface(robot: Robot) -> Surface:
    """Creates the surface of a robot in its base frame, by its collision shapes if it has no visual ones.

    Raises ``ValueError`` if a shape is neither a box, cylinder, sphere nor mesh, or a mesh file cannot be read.
    """
    description = Description(robot.urdf)
    links = [(description.links[name], frame) for name, frame in description.frames.items()]
    shapes = [(shape, frame) for link, frame in links for shape in link.visuals]
    shapes = shapes or [(shape, frame) for link, frame in links for shape in link.shapes]
    try:
        return Surface.join([part for shape, frame in shapes for part in _parts(shape, frame, robot.urdf)])
    except ValueError as error:
        raise ValueError(f"robot {robot.name!r} cannot be rendered with its URDF {robot.urdf}: {error}") from error


def _parts(shape: Shape, link: Frame, urdf: Path) -> list[Surface]:
    """Creates the surfaces of a shape. A mesh file may hold several of different colors."""
    pose = link @ shape.frame
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = pose.rotation, pose.position
    if shape.kind == "mesh":
        meshes = load_mesh(find_mesh(shape.file, urdf), shape.sizes)
    else:
        meshes = [_primitive(shape)]
    return [Surface.of_solid(mesh.apply_transform(matrix), shape.color or _own_color(mesh)) for mesh in meshes]


def _primitive(shape: Shape) -> trimesh.Trimesh:
    if shape.kind == "box":
        return trimesh.creation.box(shape.sizes)
    if shape.kind == "cylinder":
        radius, length = shape.sizes
        return trimesh.creation.cylinder(radius, length, sections=SEGMENTS)
    if shape.kind == "sphere":
        return trimesh.creation.icosphere(subdivisions=3, radius=shape.sizes[0])
    raise ValueError(f"a visual shape is a {shape.kind}; use a box, cylinder, sphere or mesh")


def _own_color(mesh: trimesh.Trimesh) -> tuple[float, ...]:
    """Returns the main color that a mesh file states, or :data:`~rover_rl.sims.rendering.scenery.UNPAINTED`."""
    visual: Any = mesh.visual
    if not visual.defined:
        return UNPAINTED
    painted = visual.material if visual.kind == "texture" else visual
    return tuple(painted.main_color[:3] / 255)
