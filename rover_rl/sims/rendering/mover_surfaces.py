"""Surfaces of the parts of movers, and where they are in a picture."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from threading import Lock
from typing import Any, NamedTuple

import numpy as np
import trimesh

from rover_rl.native.warp import wp
from rover_rl.sims.rendering.kernels import rays
from rover_rl.sims.rendering.launches import DEVICE, array
from rover_rl.sims.rendering.looks import Look, looks_of
from rover_rl.sims.rendering.scenery import SKIN
from rover_rl.sims.rendering.scenes import traced_mesh
from rover_rl.sims.rendering.surfaces import SEGMENTS, Surface
from rover_rl.worlds import World
from rover_rl.worlds.movers.mover import KINDS, Kind
from rover_rl.worlds.movers.parts import Parts

SHOULDERS, HEAD = 0.32, 0.11
"""Height of the shoulders below the top of a person of 1.75 m, and radius of the head, m."""


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


class FormMeshes:
    """Meshes of the forms of parts on a device, each made when it is first asked for."""

    def __init__(self, device: Any = DEVICE) -> None:
        self._device = device
        self._numbers: dict[Form, int] = {}
        self._surfaces: list[Surface] = []
        self._meshes: list[wp.Mesh] = []
        self._arrays: rays.Forms | None = None
        self.reaches: list[float] = []
        """Radius of a sphere around the origin of each form that contains it, m."""

    def number(self, form: Form) -> int:
        """Returns the number of a form."""
        if form not in self._numbers:
            self._numbers[form] = len(self._numbers)
            surface = part_surface(form)
            self._surfaces.append(surface)
            self._meshes.append(traced_mesh(surface, self._device))
            self.reaches.append(float(np.linalg.norm(surface.vertices, axis=1).max()))
            self._arrays = None
        return self._numbers[form]

    @property
    def arrays(self) -> rays.Forms:
        """What the kernels look up. New forms are in new arrays; the old ones stay as they are."""
        if self._arrays is None:
            joined, device, forms = Surface.join(self._surfaces), self._device, rays.Forms()
            starts = np.cumsum([0, *(len(one.faces) for one in self._surfaces[:-1])])
            forms.meshes = array([mesh.id for mesh in self._meshes], wp.uint64, device)
            forms.first_triangles, forms.triangles = array(starts, int, device), array(joined.faces, int, device)
            forms.normals = array(joined.normals, wp.vec3, device)
            # Squares turn displayed colors into intensities.
            forms.colors = array(joined.colors**2, wp.vec3, device)
            self._arrays = forms
        return self._arrays


class MoverSurfaces:
    """Meshes of the parts of a world's movers. Several threads may call it."""

    def __init__(self, world: World) -> None:
        self._world, self._meshes, self._lock = world, FormMeshes(), Lock()

    def place(self, placing: rays.Placing, parts: Parts | None, eye: np.ndarray) -> object:
        """Sets where parts are, for a camera at ``eye [3]`` (m). Returns what must live as long as ``placing``."""
        shown = parts.in_view(eye) if parts is not None else ()
        placing.parts, placing.root = len(shown), -1
        if parts is None or not len(shown):
            return None
        position, orientation = parts.position[0].numpy()[shown], parts.orientation[0].numpy()[shown]
        with self._lock:
            forms = forms_of(self._world, parts)
            numbers = [self._meshes.number(forms[part]) for part in shown]
            placing.forms = self._meshes.arrays
            reach = np.array(self._meshes.reaches)[numbers, None]
            boxes = [array(position + sign * reach, wp.vec3) for sign in (-1, 1)]
            tree = wp.Bvh(*boxes)
        placing.tree = tree.id
        placing.part_poses = wp.array(np.hstack((position, orientation)), dtype=wp.transform, device=DEVICE)
        placing.part_forms = array(numbers, int)
        return tree


@lru_cache(maxsize=512)
def part_surface(form: Form) -> Surface:
    """Creates the surface of a part in its own frame."""
    length, width, height = form.size
    if form.look.is_figure:
        return _figure(length / 2, height, form.look.color)
    if form.kind == "box":
        solid = trimesh.creation.box((length, width, height))
    elif form.kind == "cylinder":
        solid = trimesh.creation.cylinder(length / 2, height, sections=SEGMENTS)
    else:
        solid = trimesh.creation.capsule(height - length, length / 2, (SEGMENTS, SEGMENTS // 2))
    return Surface.of_solid(solid, form.look.color)


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
    return Surface.join([Surface.of_solid(trunk, color), Surface.of_solid(ball, SKIN)])
