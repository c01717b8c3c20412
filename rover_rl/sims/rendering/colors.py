"""Colors that rays see in each row's world, with the light of films, the same in every simulator."""

from __future__ import annotations

import math
from typing import NamedTuple
from weakref import WeakKeyDictionary

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

from rover_rl.native.warp import stream_of, wp
from rover_rl.sims.movers.field import MoverField
from rover_rl.sims.rendering.kernels import rays
from rover_rl.sims.rendering.kernels.colors import trace_colors
from rover_rl.sims.rendering.looks import looks_of
from rover_rl.sims.rendering.mover_surfaces import Form, FormMeshes
from rover_rl.sims.rendering.scenes import AT_ORIGIN, FAR_BELOW, scene_of, traced_mesh
from rover_rl.sims.rendering.surfaces import Surface, ground_surface, obstacles_surface, post_surface
from rover_rl.worlds import World
from rover_rl.worlds.table import SlotTable, WorldTable


class _Built(NamedTuple):
    """Scene of a world, and its meshes, to which it holds no reference."""

    scene: rays.Scene
    meshes: list[wp.Mesh]


class ColorCaster:
    """Tells the colors that rays see in the worlds of the rows of a batch.

    They are those of films: ground with its grid, obstacles, movers, other rovers of a group, the post of the goal,
    sky, sun, shadows and haze. The scene of a world is built when a row first needs it. Unlike that of a film, it lacks
    the rover itself and the shade of corners, which takes long to compute.

    Args:
        worlds: world of each row.
        movers: movers of the rows.
    """

    def __init__(self, worlds: WorldTable, movers: MoverField) -> None:
        self._worlds, self._movers, self._entered = worlds, movers, worlds.follow()
        self._device = worlds.slots.device
        self._wp_device = wp.device_from_torch(self._device)
        # Rovers may come back to a world that another one has replaced.
        self._built: WeakKeyDictionary[World, _Built] = WeakKeyDictionary()
        # Scene of each slot, and forms and sizes of the parts of its movers.
        self._scenes = wp.zeros(worlds.capacity, dtype=rays.Scene, device=self._wp_device)
        self._forms = SlotTable((), torch.int32, self._device)
        self._reaches = SlotTable((), torch.float32, self._device)
        self._meshes = FormMeshes(self._wp_device)
        # Poses of the scenery, and of what is out of sight.
        self._still = torch.tensor((AT_ORIGIN, (*FAR_BELOW, *AT_ORIGIN[3:])), device=self._device)
        # The tree of the last launch, which may still run.
        self._tree: wp.Bvh | None = None

    def cast(self, origins: Tensor, directions: Tensor, posts: Tensor, spread: float) -> Tensor:
        """Returns the color that each ray sees as a screen shows it: red, green and blue, 0 to 1, ``[N, 3, K]``.

        Args:
            origins: starts of the rays in the world frame, ``[N, K, 3]``, m.
            directions: directions in the world frame, of any length but 0, ``[N, K, 3]``.
            posts: feet of the posts of the goals, ``[N, 3]``, m.
            spread: width of what a ray stands for at a distance of 1 m, m. It blurs the pattern of the ground.
        """
        with wp.ScopedStream(stream_of(self._device)):
            for slot, world in self._entered().items():
                self._enter(slot, world)
            colors = torch.empty(len(origins), 3, origins.shape[1], device=self._device)
            starts, ways = (wp.from_torch(part.float().contiguous(), dtype=wp.vec3) for part in (origins, directions))
            poses = wp.from_torch(self._poses(posts), dtype=wp.transform)
            inputs = [self._scenes, wp.from_torch(self._worlds.slots), poses, self._placing(), starts, ways, spread]
            inputs.append(wp.from_torch(colors))
            wp.launch(trace_colors, (len(origins), origins.shape[1]), inputs, device=self._wp_device)
        return colors

    def _enter(self, slot: int, world: World) -> None:
        """Puts the scene of a world and the forms of its movers into a slot."""
        if world not in self._built:
            self._built[world] = self._build(world)
        scene = wp.array([self._built[world].scene], dtype=rays.Scene, device=self._wp_device)
        wp.copy(self._scenes, scene, dest_offset=slot, count=1)
        parts = self._movers.parts_of(world)
        looked = zip(parts, looks_of(world, len(parts)), strict=True)
        numbers = [self._meshes.number(Form(part.kind, part.size, look)) for part, look in looked]
        self._forms[slot] = torch.tensor(numbers, dtype=torch.int32)
        self._reaches[slot] = torch.tensor([self._meshes.reaches[number] for number in numbers])

    def _build(self, world: World) -> _Built:
        ground, obstacles = ground_surface(world.terrain, math.inf), obstacles_surface(world, math.inf)
        scenery, post = ground if obstacles is None else Surface.join([ground, obstacles]), post_surface()
        # Another post stands for the rover, out of sight.
        bodies = [scenery, post, post]
        meshes = [traced_mesh(body, self._wp_device) for body in bodies]
        # All vertices see the whole sky, and rays tell whether the sun shines.
        openness = np.ones(sum(len(body.vertices) for body in bodies))
        lit = openness, 0.5 * openness
        return _Built(scene_of(world.terrain, len(ground.faces), bodies, meshes, *lit, self._wp_device), meshes)

    def _poses(self, posts: Tensor) -> Tensor:
        """Returns the poses of scenery, rover and post, ``[N, 3, 7]``."""
        poses = self._still[[0, 1, 1]].repeat(len(posts), 1, 1)
        poses[:, 2, :3] = posts
        return poses

    def _placing(self) -> rays.Placing:
        """Returns where the parts of the movers of all rows are, those of a row in a branch of one tree."""
        placing, parts = rays.Placing(), self._movers.parts
        if parts is None or not parts.kind.shape[1]:
            return placing
        count = parts.kind.shape[1]
        slots = self._worlds.slots
        forms, reach = (
            pad(table.values[slots], (0, max(0, count - table.values.shape[1])))[:, :count].contiguous()
            for table in (self._forms, self._reaches)
        )
        # What is no part is out of sight.
        position = torch.where(parts.kind[..., None] < 0, self._still[1, :3], parts.position)
        poses = torch.cat((position, parts.orientation), -1)
        corners = (wp.from_torch((position + sign * reach[..., None]).flatten(0, 1), dtype=wp.vec3) for sign in (-1, 1))
        rows = torch.arange(len(forms), dtype=torch.int32, device=self._device).repeat_interleave(count)
        self._tree = wp.Bvh(*corners, groups=wp.from_torch(rows))
        placing.parts, placing.tree, placing.forms = count, self._tree.id, self._meshes.arrays
        placing.part_poses = wp.from_torch(poses.flatten(0, 1), dtype=wp.transform)
        placing.part_forms = wp.from_torch(forms.flatten())
        return placing
