"""Colors that rays see in each row's world, with the light of films, the same in every simulator."""

from __future__ import annotations

from weakref import WeakKeyDictionary

import torch
from torch import Tensor
from torch.nn.functional import pad

from rover_rl.native.warp import stream_of, wp
from rover_rl.sims.movers.field import MoverField
from rover_rl.sims.rendering.kernels import Scenery, trace_colors
from rover_rl.sims.rendering.renderer import TracedShapes, TracedWorld
from rover_rl.sims.rendering.scenery import looks_of
from rover_rl.sims.rendering.surfaces import Form, post_surface
from rover_rl.worlds import World
from rover_rl.worlds.table import SlotTable, WorldTable

FAR_BELOW = (0.0, 0.0, -1e6)
"""Position of what is out of sight, m."""


class ColorCaster:
    """Tells the colors that rays see in the worlds of the rows of a batch, among their movers.

    They are those of films: ground with its grid, obstacles, movers, other rovers of a group, the post of the goal,
    sky, sun, shadows and haze, but not the rover itself. The scenery of a world is built when a row first needs it.
    """

    def __init__(self, worlds: WorldTable, movers: MoverField) -> None:
        self._worlds, self._movers, self._entered = worlds, movers, worlds.follow()
        self._device = worlds.slots.device
        self._wp_device = wp.device_from_torch(self._device)
        # Rovers may come back to a world that another one has replaced.
        self._built: WeakKeyDictionary[World, TracedWorld] = WeakKeyDictionary()
        # Scenery of each slot, and shapes and sizes of the parts of its movers.
        self._sceneries = wp.zeros(worlds.capacity, dtype=Scenery, device=self._wp_device)
        self._numbers = SlotTable((), torch.int32, self._device)
        self._reaches = SlotTable((), torch.float32, self._device)
        self._shapes = TracedShapes([post_surface()], self._wp_device)
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
            rays = [wp.from_torch(part.float().contiguous(), dtype=wp.vec3) for part in (origins, directions)]
            inputs = [self._sceneries, wp.from_torch(self._worlds.slots), self._bodies(posts), *rays, spread]
            inputs.append(wp.from_torch(colors))
            wp.launch(trace_colors, (len(origins), origins.shape[1]), inputs, device=self._wp_device)
        return colors

    def _enter(self, slot: int, world: World) -> None:
        if world not in self._built:
            self._built[world] = TracedWorld(world, self._wp_device)
        scenery = wp.array([self._built[world].scenery], dtype=Scenery, device=self._wp_device)
        wp.copy(self._sceneries, scenery, dest_offset=slot, count=1)
        parts = self._movers.parts_of(world)
        looked = zip(parts, looks_of(world, len(parts)), strict=True)
        numbers = [self._shapes.number(Form(part.kind, part.size, look)) for part, look in looked]
        reaches = self._shapes.reaches
        self._numbers[slot] = torch.tensor(numbers, dtype=torch.int32)
        self._reaches[slot] = torch.tensor([reaches[number] for number in numbers])

    def _bodies(self, posts: Tensor) -> object:
        """Returns the posts and the parts of the movers of all rows, those of a row in a branch of one tree."""
        rows, parts = len(posts), self._movers.parts
        upright = posts.new_tensor((0.0, 0.0, 0.0, 1.0)).expand(rows, 4)
        poses = torch.cat((posts, upright), -1).float()[:, None]
        numbers = torch.zeros(rows, 1, dtype=torch.int32, device=self._device)
        reaches = torch.full((rows, 1), self._shapes.reaches[0], device=self._device)
        if parts is not None and (count := parts.kind.shape[1]):
            own = [
                pad(table.values[self._worlds.slots], (0, max(0, count - table.values.shape[1])))[:, :count]
                for table in (self._numbers, self._reaches)
            ]
            # What is no part is out of sight.
            position = torch.where(parts.kind[..., None] < 0, posts.new_tensor(FAR_BELOW), parts.position)
            poses = torch.cat((poses, torch.cat((position, parts.orientation), -1)), 1)
            numbers, reaches = torch.cat((numbers, own[0]), 1), torch.cat((reaches, own[1]), 1)
        groups = torch.arange(rows, dtype=torch.int32, device=self._device).repeat_interleave(poses.shape[1])
        flat = poses.flatten(0, 1).contiguous(), numbers.flatten(), reaches.flatten()
        bodies, self._tree = self._shapes.bodies(*flat, groups)
        return bodies
