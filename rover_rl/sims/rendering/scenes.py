"""Scenes that rays are traced in: meshes of bodies, and what the kernels look up of them."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import Any

import numpy as np
import torch

from rover_rl.native.warp import wp
from rover_rl.sims.rendering.kernels import light, rays
from rover_rl.sims.rendering.launches import DEVICE, array, launch
from rover_rl.sims.rendering.surfaces import Surface
from rover_rl.worlds import Terrain

AT_ORIGIN = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
"""Position and quaternion (x, y, z, w) of the scenery."""
FAR_BELOW = (0.0, 0.0, -1e6)
"""Position of what is out of sight, as the post without a goal, m."""


def traced_mesh(surface: Surface, device: Any = DEVICE) -> wp.Mesh:
    """Creates the mesh that rays are traced against."""
    return wp.Mesh(array(surface.vertices, wp.vec3, device), array(surface.faces.flatten(), int, device))


def scene_of(
    terrain: Terrain,
    ground_faces: int,
    bodies: Sequence[Surface],
    meshes: Sequence[wp.Mesh],
    openness: np.ndarray,
    sunshine: np.ndarray,
    device: Any = DEVICE,
) -> rays.Scene:
    """Creates a scene of bodies.

    Args:
        terrain: the ground.
        ground_faces: number of its triangles, with which the scenery begins.
        bodies: surfaces of the scenery, the rover and the post.
        meshes: mesh of each. The scene holds no reference to them.
        openness, sunshine: light on each vertex of all bodies: see the fields of ``rays.Scene``.
        device: device of the meshes.
    """
    scene, joined, heights = rays.Scene(), Surface.join(bodies), terrain.heights
    scene.meshes = array([mesh.id for mesh in meshes], wp.uint64, device)
    scene.radii = array([np.linalg.norm(body.vertices, axis=1).max() for body in bodies], float, device)
    scene.first_triangles = array(np.cumsum([0, *(len(body.faces) for body in bodies[:-1])]), int, device)
    scene.level = torch.cat((heights[0], heights[-1], heights[:, 0], heights[:, -1])).mean().item()
    low, high = bodies[rays.ROVER].vertices.min(0), bodies[rays.ROVER].vertices.max(0)
    scene.rover_center, scene.rover_half = wp.vec3(*((low + high) / 2)), wp.vec3(*((high - low) / 2))
    is_ground = np.arange(len(joined.faces)) < ground_faces
    scene.triangles = array(joined.faces, int, device)
    # Squares turn displayed colors into intensities.
    scene.colors = array(np.column_stack((joined.colors**2, is_ground)), wp.vec4, device)
    scene.normals = array(joined.normals, wp.vec3, device)
    scene.openness, scene.sunshine = array(openness, float, device), array(sunshine, float, device)
    scene.noise = _noise(str(device))
    return scene


@cache
def _noise(device: str) -> wp.array:
    """Returns the noise of the ground, which all scenes on a device share."""
    if device != DEVICE:
        return _noise(DEVICE).to(device)
    side = rays.NOISE_CELLS * rays.NOISE_SAMPLES
    noise = wp.empty((side, side), dtype=float, device=DEVICE)
    launch(light.find_noise, (side, side), [noise])
    return noise
