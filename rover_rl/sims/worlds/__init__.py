"""Worlds: terrain, obstacles, and the free space for a rover."""

from __future__ import annotations

import inspect as signatures
from collections.abc import Callable
from functools import lru_cache

from rover_rl.registry import Registry
from rover_rl.sims.worlds.free_space import FreeSpace, free_space
from rover_rl.sims.worlds.generators import inspect, maze, moon
from rover_rl.sims.worlds.obstacles import Obstacle, boulder, box, boxes, cylinder, cylinders
from rover_rl.sims.worlds.placement import rest_on_ground
from rover_rl.sims.worlds.terrain import Terrain
from rover_rl.sims.worlds.world import World

WORLDS: dict[str, Callable[[int], World]] = {"inspect": inspect, "moon": moon, "maze": maze}
"""Built-in worlds: functions from a seed to a world, by name."""


_REGISTRY = Registry("world", WORLDS, also=", 'name:seed', or a World")


def register_world(name: str, world: World | Callable[..., World] | str) -> None:
    """Registers a world under a name, for ``world_n``, ``EnvConfig`` and ``--world``.

    Args:
        name: new name of letters, digits, ``_``, ``-`` and ``.``.
        world: world, function that returns a world and takes either a seed (int) or no argument, or
            ``"module:attribute"`` of either.

    Raises:
        ValueError: if the name is taken or has other characters.

    Example:
        >>> register_world("canyon", lambda seed: World(f"canyon-{seed}", Terrain.flat(((-9, 9), (-9, 9)))))
        >>> get_world("canyon:3").name
        'canyon-3'
    """
    _REGISTRY.register(name, world)


def world_names() -> list[str]:
    """Returns the names of all worlds: built-in, registered, and from installed packages."""
    return _REGISTRY.names()


def get_world(world: str | World) -> World:
    """Returns a world by name. Returns a :class:`World` unchanged.

    Args:
        world: name in :func:`world_names`, ``"module:attribute"`` of a world or of a function that returns one, or a
            world. A suffix ``:seed`` selects another layout, for example ``"maze:7"`` or ``"my_package:canyon:7"``.

    Returns:
        The world. The same name returns the same object (the last 256 names are cached).

    Raises:
        ValueError: if the name is unknown, refers to something else than a world, or has a seed that the world does
            not take.
    """
    if isinstance(world, World):
        return world
    name, _, seed = str(world).rpartition(":")
    if name and seed.isascii() and seed.isdigit():
        return _make_world(name, int(seed))
    return _make_world(str(world), 0 if world in WORLDS else None)


@lru_cache(maxsize=256)
def _make_world(name: str, seed: int | None) -> World:
    part = _REGISTRY.find(name)
    if callable(part):
        takes_seed = bool(signatures.signature(part).parameters)
        if seed is not None and not takes_seed:
            raise ValueError(f"world {name!r} takes no seed, got {seed}")
        part = _REGISTRY.call(name, part, *([seed or 0] if takes_seed else []))
    elif seed is not None:
        raise ValueError(f"world {name!r} takes no seed, got {seed}")
    if not isinstance(part, World):
        raise ValueError(f"world {name!r} must be a World or a function that returns one, got {type(part).__name__}")
    return part


__all__ = [
    "WORLDS",
    "FreeSpace",
    "Obstacle",
    "Terrain",
    "World",
    "boulder",
    "box",
    "boxes",
    "cylinder",
    "cylinders",
    "free_space",
    "get_world",
    "register_world",
    "rest_on_ground",
    "world_names",
]
