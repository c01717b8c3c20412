"""Worlds with wider passages: the same layout, larger, for larger robots."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from rover_rl.worlds.obstacles import Obstacle, Solids, groups_of
from rover_rl.worlds.region import Area, Region
from rover_rl.worlds.terrain import Terrain
from rover_rl.worlds.world import World


def widened(world: World, scale: float) -> World:
    """Returns a world without movers whose layout is ``scale`` times as large, about the middle of its start area.

    Passages, obstacles and areas grow along x and y. On level ground, heights stay; else, they grow as well, so that
    slopes stay.

    Raises:
        ValueError: if something moves in the world, which knows its ways.
    """
    if world.movers:
        raise ValueError(f"world {world.name!r} has movers: only its function can scale it, with an argument 'scale'")
    upward = 1.0 if world.terrain.is_flat else scale
    x, y = ((low + high) / 2 for low, high in world.spawn_range)
    factors = torch.tensor((scale, scale, upward), dtype=torch.float64)
    terrain, center = world.terrain, (x, y)
    return replace(
        world,
        terrain=Terrain(terrain.heights * upward, terrain.cell * scale, _moved(terrain.origin, center, scale)),
        obstacles=_scaled(world.obstacles, factors, torch.tensor((x, y, 0.0), dtype=torch.float64)),
        spawn_range=_area(world.spawn_range, center, scale),
        goal_range=_area(world.goal_range, center, scale),
        bounds=_area(world.bounds, center, scale),
        spawn_region=_region(world.spawn_region, center, scale),
        goal_region=_region(world.goal_region, center, scale),
        spawn_height=world.spawn_height * upward,
        spawn_height_areas=tuple(
            (_area(area, center, scale), height * upward) for area, height in world.spawn_height_areas
        ),
    )


def _scaled(obstacles: Sequence[Obstacle], factors: Tensor, middle: Tensor) -> list[Obstacle]:
    """Returns solids that are larger by ``factors [3]`` about ``middle [3]``. Their faces stay the same."""
    scaled: list[Obstacle] = []
    for group in groups_of(obstacles):
        normals, offsets = group.planes[..., :3] / factors, group.planes[..., 3:]
        offsets = offsets + (group.planes[..., :3] - normals) @ middle[:, None]
        planes = torch.cat((normals, offsets), -1) / normals.norm(dim=-1, keepdim=True)
        vertices = middle + (group.vertices - middle) * factors
        scaled += Solids(vertices, planes, group.faces, group.outline).obstacles()
    return scaled


def _moved(point: tuple[float, float], center: tuple[float, float], scale: float) -> tuple[float, float]:
    x, y = (middle + (at - middle) * scale for at, middle in zip(point, center, strict=True))
    return x, y


def _area(area: Area, center: tuple[float, float], scale: float) -> Area:
    low, high = (_moved(corner, center, scale) for corner in zip(*area, strict=True))
    return (low[0], high[0]), (low[1], high[1])


def _region(region: Region | None, center: tuple[float, float], scale: float) -> Region | None:
    return region and Region(region.mask, region.cell * scale, _moved(region.origin, center, scale))
