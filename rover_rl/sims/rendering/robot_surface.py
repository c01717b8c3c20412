"""Surface of a robot: its visual shapes, with all joint angles at zero."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from rover_rl.robots import Robot
from rover_rl.robots.shapes import Frame, Shape
from rover_rl.robots.urdf.meshes import load_mesh
from rover_rl.sims.rendering.scenery import UNPAINTED
from rover_rl.sims.rendering.surfaces import SEGMENTS, Surface


def robot_surface(robot: Robot) -> Surface:
    """Creates the surface of a robot in its base frame.

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
    meshes = load_mesh(Path(shape.file), shape.sizes) if shape.kind == "mesh" else [_primitive(shape)]
    return [Surface.of_solid(mesh.apply_transform(matrix), shape.color or _own_color(mesh)) for mesh in meshes]


def _primitive(shape: Shape) -> trimesh.Trimesh:
    if shape.kind == "box":
        return trimesh.creation.box(shape.sizes)
    if shape.kind == "cylinder":
        radius, length = shape.sizes
        return trimesh.creation.cylinder(radius, length, sections=SEGMENTS)
    return trimesh.creation.icosphere(subdivisions=3, radius=shape.sizes[0])


def _own_color(mesh: trimesh.Trimesh) -> tuple[float, ...]:
    """Returns the main color that a mesh file states, or :data:`~rover_rl.sims.rendering.scenery.UNPAINTED`."""
    visual: Any = mesh.visual
    if not visual.defined:
        return UNPAINTED
    painted = visual.material if visual.kind == "texture" else visual
    return tuple(painted.main_color[:3] / 255)
