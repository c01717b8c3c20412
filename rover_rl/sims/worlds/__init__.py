"""Worlds: terrain, obstacles, and the free space for a rover."""

from __future__ import annotations

import inspect as signatures
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path

from rover_rl.registry import Registry
from rover_rl.sims.worlds.actor import Actor
from rover_rl.sims.worlds.files.suffixes import is_world_file
from rover_rl.sims.worlds.free_space import FreeSpace, free_space
from rover_rl.sims.worlds.inspect_site import inspect
from rover_rl.sims.worlds.maze import maze
from rover_rl.sims.worlds.moon import moon
from rover_rl.sims.worlds.obstacles import Obstacle, boulder, box, cylinder
from rover_rl.sims.worlds.placement import rest_on_ground
from rover_rl.sims.worlds.terrain import Terrain
from rover_rl.sims.worlds.world import World

WORLDS: dict[str, Callable[[int], World]] = {"inspect": inspect, "moon": moon, "maze": maze}
"""Built-in worlds: functions from a seed to a world, by name."""


_REGISTRY = Registry("world", WORLDS, also=", 'name:seed', the path of a file, or a World")


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
            world. A suffix ``:seed`` selects another layout, for example ``"maze:7"`` or ``"my_package:canyon:7"``. The
            path of a world file also is a name: see :meth:`World.from_file`.

    Returns:
        The world. The same name returns the same object (the last 256 names are cached).

    Raises:
        FileNotFoundError: if the name is a path, and there is no such file.
        ValueError: if the name is unknown, refers to something else than a world, or has a seed that the world does
            not take.
    """
    if isinstance(world, World):
        return world
    if is_world_file(str(world)):
        return _read_file(Path(world).resolve())
    name, _, seed = str(world).rpartition(":")
    if name and seed.isascii() and seed.isdigit():
        return _make_world(name, int(seed))
    return _make_world(str(world), 0 if world in WORLDS else None)


def _read_file(path: Path) -> World:
    """Returns the world in a file, which is read again after it has changed."""
    status = path.stat() if path.exists() else None
    return _read_version(path, None if status is None else (status.st_mtime_ns, status.st_size))


@lru_cache(maxsize=256)
def _read_version(path: Path, version: tuple[int, int] | None) -> World:
    return World.from_file(path)


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
    "Actor",
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
