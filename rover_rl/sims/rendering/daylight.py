"""Meshes of a world and its sky in daylight, for viewers without a ray tracer. Colors of the ground hold shadows."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
import trimesh
from PIL import Image
from scipy.ndimage import map_coordinates
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

from rover_rl.sims.rendering.renderer import Sight
from rover_rl.sims.rendering.scenery import GROUND, HORIZON, SUN, ZENITH
from rover_rl.sims.rendering.surfaces import Surface, ground_surface, obstacles_surface
from rover_rl.worlds import World

SHADOW = 0.55
"""Brightness of the ground in the shadow of obstacles."""
CELL = 0.25
"""Largest cell of flat ground, m: its vertices hold the shadows."""
SKY_RADIUS = 400.0
"""Radius of the dome of the sky, m."""
_DEPTH, _REACH = 3.0, 300.0
"""Depth below the edge at which the land around begins under the terrain, and how far it goes on, m."""


def solid(surface: Surface, brightness: np.ndarray | None = None) -> trimesh.Trimesh:
    """Converts a surface, with the brightness of each vertex, ``[V]``, to a mesh as a page shows it."""
    colors = np.empty((len(surface.vertices), 3))
    colors[surface.faces.flatten()] = np.repeat(surface.colors, 3, axis=0)
    if brightness is not None:
        colors *= brightness[:, None]
    return painted_mesh(surface.vertices, surface.faces, surface.normals, colors)


def painted_mesh(vertices: np.ndarray, faces: Any, normals: np.ndarray, colors: np.ndarray) -> trimesh.Trimesh:
    """Creates a dull mesh with a color per vertex, ``[V, 3]``, 0 to 1, as a screen shows it."""
    visual = TextureVisuals(material=PBRMaterial(metallicFactor=0.0, roughnessFactor=1.0))
    # Colors of vertices are intensities.
    rgba = np.column_stack((np.clip(colors, 0, 1) ** 2.2, np.ones(len(colors))))
    visual.vertex_attributes["color"] = np.uint8(np.round(255 * rgba))
    return trimesh.Trimesh(vertices, faces, vertex_normals=normals, visual=visual, process=False)


def world_meshes(world: World) -> dict[str, trimesh.Trimesh]:
    """Creates the meshes of a world: its ``ground``, the ``land`` around and, if there are any, its ``obstacles``."""
    ground, obstacles = ground_surface(world.terrain, CELL), obstacles_surface(world)
    points = torch.from_numpy(ground.vertices) + torch.tensor((0.0, 0.0, 0.01))
    dark = Sight(world).hidden(points, points + 100 * torch.tensor(SUN)).numpy()
    meshes = {"ground": solid(ground, np.where(dark, SHADOW, 1.0) * _mottle(ground.vertices)), "land": _land(world)}
    if obstacles is not None:
        meshes["obstacles"] = solid(obstacles)
    return meshes


def _mottle(points: np.ndarray) -> np.ndarray:
    """Brightness of soil at points ``[V, 3]`` (m): smooth noise of several sizes around 1."""
    noise = np.random.default_rng(0).uniform(-1, 1, (64, 64))
    total = np.ones(len(points))
    for size, strength in ((6.0, 0.05), (1.7, 0.05), (0.45, 0.04)):
        total += strength * map_coordinates(noise, points[:, :2].T / size % 64, order=1, mode="grid-wrap")
    return total


def _land(world: World) -> trimesh.Trimesh:
    """Creates the flat land around a terrain, which fades into the haze."""
    (left, right), (bottom, top) = world.terrain.extent
    heights = world.terrain.heights
    level = float(np.concatenate([np.asarray(heights[i]) for i in (0, -1)] + [np.asarray(heights[:, -1])]).mean())
    center = np.array(((left + right) / 2, (bottom + top) / 2))
    half = np.array(((right - left) / 2, (top - bottom) / 2))
    corners = np.array(((-1, -1), (1, -1), (1, 1), (-1, 1)))
    # It begins far below the terrain, so that there is no gap at the edge.
    rings = [(half * 0.99, _DEPTH), (half, 0.02), (half + 40, 0.02), (half + _REACH, 0.02)]
    parts = [np.column_stack((center + corners * ring, np.full(4, level - depth))) for ring, depth in rings]
    vertices = np.concatenate(parts)
    sides = [(4 * ring + side, 4 * ring + (side + 1) % 4) for ring in range(len(rings) - 1) for side in range(4)]
    faces = [face for a, b in sides for face in ((a, a + 4, b + 4), (a, b + 4, b))]
    share = np.repeat((0.0, 0.0, 0.5, 1.0), 4)[:, None]
    colors = (1 - share) * np.array(GROUND) + share * np.array(HORIZON)
    normals = np.tile((0.0, 0.0, 1.0), (len(vertices), 1))
    return painted_mesh(vertices, faces, normals, colors)


def sky_dome() -> trimesh.Trimesh:
    """Creates a sphere around everything that glows in the colors of the sky, seen from within."""
    dome = trimesh.creation.uv_sphere(SKY_RADIUS, count=(32, 32))
    dome.invert()
    height = dome.vertices[:, 2] / SKY_RADIUS
    share = np.linspace(0, 1, 256)[:, None] ** 0.6
    # The upper half of the picture is the sky, from the zenith down; the lower half is haze.
    above = np.array(HORIZON) + share[::-1] * (np.array(ZENITH) - np.array(HORIZON))
    column = np.concatenate((above, np.tile(HORIZON, (256, 1))))
    picture = Image.fromarray(np.uint8(255 * np.tile(column[:, None], (1, 4, 1))))
    glow = PBRMaterial(emissiveTexture=picture, emissiveFactor=[1.0, 1.0, 1.0], baseColorFactor=[0, 0, 0, 255])
    uv = np.column_stack((np.full(len(height), 0.5), 0.5 + 0.5 * height))
    dome.visual = TextureVisuals(uv=uv, material=glow)
    return dome
