"""Places to drive in: the ground, what stands on it, and where a rover can go."""

from __future__ import annotations

import inspect as signatures
from collections.abc import Callable
from functools import lru_cache

from rover_rl.registry import Registry
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


_REGISTRY = Registry("world", WORLDS, also=", 'name:seed', or a World")


def register_world(name: str, world: World | Callable[..., World] | str) -> None:
    """Gives a world a name, for ``world_n``, ``EnvConfig`` and ``--world``.

    Args:
        name: its name.
        world: the world; a function that makes it, with or without a seed (int) as its argument; or the
            ``"module:attribute"`` of either.

    Raises:
        ValueError: for a name that is taken, or that has other characters than letters, digits, ``_``, ``-`` and ``.``.

    Example:
        >>> register_world("canyon", lambda seed: World(f"canyon-{seed}", Terrain.flat(((-9, 9), (-9, 9)))))
        >>> get_world("canyon:3").name
        'canyon-3'
    """
    _REGISTRY.register(name, world)


def world_names() -> list[str]:
    """Names of the worlds of the package, of those registered, and of those of installed packages."""
    return _REGISTRY.names()


def get_world(world: str | World) -> World:
    """The world of that name, or the one given.

    Args:
        world: a name in :func:`world_names`, or the ``module:attribute`` of a world of your own or of a function that
            makes it; with ``:seed`` after it for another layout, as in ``"maze:7"`` or ``"my_package:canyon:7"``. The
            same name gives the same object each time.

    Raises:
        ValueError: for a name of no world.
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
        part = part(seed or 0) if takes_seed else part()
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
    "cylinder",
    "free_space",
    "get_world",
    "register_world",
    "rest_on_ground",
    "world_names",
]
