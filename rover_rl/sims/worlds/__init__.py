"""Places to drive in: the ground, what stands on it, and where a rover can go."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache

from rover_rl.sims.worlds.free_space import FreeSpace, free_space
from rover_rl.sims.worlds.inspect_site import inspect
from rover_rl.sims.worlds.maze import maze
from rover_rl.sims.worlds.moon import moon
from rover_rl.sims.worlds.obstacles import Obstacle, boulder, box, cylinder
from rover_rl.sims.worlds.placement import rest_on_ground
from rover_rl.sims.worlds.terrain import Terrain
from rover_rl.sims.worlds.world import World

WORLDS: dict[str, Callable[[int], World]] = {"inspect": inspect, "moon": moon, "maze": maze}
"""The worlds that come with the package: functions from a seed to a world, by name."""


def get_world(world: str | World) -> World:
    """The world of that name, or the one given.

    Args:
        world: a name in :data:`WORLDS`, or ``"name:seed"`` for another layout: ``"maze:7"``. The same text
            gives the same object each time.

    Raises:
        ValueError: for a text that names no world.
    """
    if isinstance(world, World):
        return world
    name, colon, seed = str(world).partition(":")
    if name not in WORLDS or (colon and not (seed.isascii() and seed.isdigit())):
        raise ValueError(f"unknown world {world!r}; use one of {sorted(WORLDS)}, 'name:seed', or a World")
    return _generate(name, int(seed or 0))


@lru_cache(maxsize=256)
def _generate(name: str, seed: int) -> World:
    return WORLDS[name](seed)


__all__ = [
    "WORLDS",
    "FreeSpace",
    "Obstacle",
    "Terrain",
    "World",
    "boulder",
    "box",
    "cylinder",
    "free_space",
    "get_world",
    "rest_on_ground",
]
