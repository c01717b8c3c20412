"""Meshes of the tests, with z up and in meters, and what worlds are like at points."""

from __future__ import annotations

import numpy as np
import torch
import trimesh
from trimesh.creation import extrude_triangulation
from trimesh.transformations import concatenate_matrices, rotation_matrix, translation_matrix

from rover_rl.worlds import Terrain, World


def inside(world: World, *points: tuple[float, float, float]) -> list[bool]:
    return world.inside(torch.tensor(points, dtype=torch.float64)).tolist()


def heights_at(world: World, *points: tuple[float, float]) -> list[float]:
    return world.height_at(torch.tensor(points, dtype=torch.float64)).tolist()


def hills(points: int = 65, side: float = 16.0) -> trimesh.Trimesh:
    """An open surface of smooth hills, on a grid of 0.25 m."""
    axis = np.linspace(-side / 2, side / 2, points)
    vertices, faces = Terrain(hill_height(*np.meshgrid(axis, axis)), side / (points - 1)).mesh()
    return trimesh.Trimesh(vertices.numpy(), faces.numpy(), process=False)


def hill_height(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return 0.4 * np.sin(x / 2) * np.cos(y / 3)


def corner_wall() -> trimesh.Trimesh:
    """A wall with the plan of an L, 2 m long, 0.3 m thick, 1 m high: closed and not convex."""
    outline = [(0.0, 0.0), (2.0, 0.0), (2.0, 0.3), (0.3, 0.3), (0.3, 2.0), (0.0, 2.0)]
    return extrude_triangulation(outline, [(0, 1, 2), (0, 2, 3), (0, 3, 4), (0, 4, 5)], 1.0)


def yard() -> trimesh.Scene:
    """Hills with a turned crate, a ball and a wall with a corner, each a node with a transform."""
    scene = trimesh.Scene()
    crate = concatenate_matrices(translation_matrix((3.0, 0.0, 0.6)), rotation_matrix(0.5, (0, 0, 1)))
    scene.add_geometry(hills(), node_name="hills")
    scene.add_geometry(trimesh.creation.box((1.0, 2.0, 1.5)), node_name="crate", transform=crate)
    scene.add_geometry(trimesh.creation.icosphere(2, 0.8), node_name="ball", transform=translation_matrix((-3, 2, 0.4)))
    scene.add_geometry(corner_wall(), node_name="corner", transform=translation_matrix((-2.0, -4.0, -0.2)))
    return scene


def house() -> trimesh.Scene:
    """A house of 12 x 10 m with a floor, four walls, an inner wall, a table and a roof."""
    scene = trimesh.Scene()
    for name, size, center in (
        ("floor", (12.0, 10.0, 0.2), (0.0, 0.0, -0.1)),
        ("north", (12.0, 0.2, 2.5), (0.0, 4.9, 1.25)),
        ("south", (12.0, 0.2, 2.5), (0.0, -4.9, 1.25)),
        ("east", (0.2, 9.6, 2.5), (5.9, 0.0, 1.25)),
        ("west", (0.2, 9.6, 2.5), (-5.9, 0.0, 1.25)),
        ("inner", (0.2, 5.0, 2.5), (1.0, -2.3, 1.25)),
        ("table", (1.6, 0.8, 0.05), (-2.0, 2.0, 0.75)),
        ("roof", (12.0, 10.0, 0.2), (0.0, 0.0, 2.6)),
    ):
        scene.add_geometry(trimesh.creation.box(size), node_name=name, transform=translation_matrix(center))
    return scene


def with_y_up(scene: trimesh.Scene) -> trimesh.Scene:
    """The scene as glTF and COLLADA expect it by default."""
    turned = scene.copy()
    turned.apply_transform(rotation_matrix(-np.pi / 2, (1, 0, 0)))
    return turned
