"""Worlds: terrain, obstacles, and areas of the task. They know no robot."""

from __future__ import annotations

import inspect as signatures
from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

from rover_rl.registry import Registry
from rover_rl.worlds.generators import (
    corridor,
    crossing,
    field,
    forest,
    gates,
    hills,
    inspect,
    maze,
    moon,
    plaza,
    ramps,
    rooms,
    with_walkers,
    yard,
)
from rover_rl.worlds.generators.layouts import DEFAULT
from rover_rl.worlds.layout_cache import stored_layout
from rover_rl.worlds.names import WorldName, WorldRange, is_world_file
from rover_rl.worlds.obstacles import Obstacle, boulder, box, boxes, cylinder, cylinders
from rover_rl.worlds.region import Region
from rover_rl.worlds.terrain import Terrain
from rover_rl.worlds.widened import widened
from rover_rl.worlds.world import World

WORLDS: dict[str, Callable[..., World]] = {
    generate.__name__: generate
    for generate in (inspect, moon, maze, rooms, forest, hills, ramps, plaza, corridor, crossing, field, yard, gates)
}
"""Built-in worlds: functions from a seed and a difficulty to a world, by name."""


WITH_WALKERS = "+walkers"
"""End of the name of any world, before a seed and a difficulty, for the same world with people who walk in it."""
_REGISTRY = Registry(
    "world",
    WORLDS,
    also=", 'name:seed', 'name:seed@difficulty', the path of a file, a World, or 'module:attribute' of your own",
)


def register_world(name: str, world: World | Callable[..., World] | str) -> None:
    """Registers a world under a name, for ``world_n``, ``EnvConfig`` and ``--world``.

    Args:
        name: new name of letters, digits, ``_``, ``-`` and ``.``.
        world: world, function that returns a world and takes a seed (int), optionally also ``difficulty`` and
            ``scale``, or no argument, or ``"module:attribute"`` of either.

    Raises:
        ValueError: if the name is taken or has other characters.

    Example:
        >>> register_world("canyon", lambda seed: World(f"canyon-{seed}", Terrain.flat((18, 18))))
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
            world. A suffix ``:seed`` selects another layout, for example ``"maze:7"`` or ``"my_package:canyon:7"``, and
            a suffix ``@difficulty``, from 0 to 1, an easier or harder one, for example ``"maze@0.2"``, ``"maze:7@1"``.
            The path of a world file also is a name: see :meth:`World.from_file`. A suffix ``+walkers`` adds people who
            walk: ``"maze+walkers:7@0.3"``, ``"yard.yaml+walkers"``. A last suffix ``*scale`` widens passages, as in
            ``"maze:7*1.6"``: the same layout for larger robots. The same name returns the same object (the last 256
            names are cached).

    Raises:
        FileNotFoundError: if the name is a path, and there is no such file.
        ValueError: if the name is unknown, that of a range, or that of something else than a world; if it has a seed or
            a difficulty or a scale that the world does not take, or one that is out of range.
    """
    if isinstance(world, World):
        return world
    if WITH_WALKERS in str(world) and WorldRange.parse(str(world)) is None:
        name = WorldName.parse(str(world))
        if name.part.endswith(WITH_WALKERS):
            return _make_with_walkers(replace(name, part=name.part.removesuffix(WITH_WALKERS)))
    if is_world_file(str(world)):
        return _read_file(Path(world).resolve())
    seeds = WorldRange.parse(str(world))
    if seeds is not None:
        raise ValueError(f"{world!r} names {len(seeds)} worlds; name one of them, such as {seeds.name(0)!r}")
    name = WorldName.parse(str(world))
    if name.seed is None and name.part in WORLDS:
        name = replace(name, seed=0)
    if name.scale == 1:
        name = replace(name, scale=None)
    return _make_world(name) if name.scale is None else _make_scaled(name)


@lru_cache(maxsize=256)
def _make_with_walkers(name: WorldName) -> World:
    """Returns a world with people. Seed and difficulty are those of the people, and of the world if it takes them."""
    if is_world_file(name.part):
        world = _read_file(Path(name.part).resolve())
    else:
        takes = _taken_by(_REGISTRY.find(name.part))
        seed = name.seed if takes - {"difficulty", "scale"} else None
        world = get_world(str(replace(name, seed=seed, difficulty=name.difficulty if "difficulty" in takes else None)))
    return with_walkers(world, name.seed or 0, DEFAULT if name.difficulty is None else name.difficulty)


def takes_scale(world: str) -> bool:
    """Returns whether a name is that of a world, or of a range, that can have a scale, and states none.

    Raises:
        ValueError: if it is no name of a world.
    """
    if is_world_file(world):
        return False
    name = WorldRange.parse(world) or WorldName.parse(world)
    part = name.part.removesuffix(WITH_WALKERS)
    if name.scale is not None or is_world_file(part):
        return False
    return part in WORLDS or "scale" in _taken_by(_REGISTRY.find(part))


@lru_cache(maxsize=256)
def _make_scaled(name: WorldName) -> World:
    """Returns a world with a scale: by its function, or for a built-in one without movers, a larger copy."""
    assert name.scale is not None
    if is_world_file(name.part):
        raise ValueError(f"{name.part!r} is a file, whose world has no scale, got {name.scale:g}")
    if "scale" in _taken_by(_REGISTRY.find(name.part)):
        return _make_world(name)
    if name.part in WORLDS:
        return widened(_make_world(replace(name, scale=None)), name.scale)
    raise ValueError(f"world {name.part!r} takes no scale, got {name.scale:g}")


def _taken_by(part: Any) -> set[str]:
    """Returns the names of the arguments that the function of a world takes; none for a world."""
    return set(signatures.signature(part).parameters) if callable(part) else set()


def _read_file(path: Path) -> World:
    """Returns the world in a file, which is read again after it has changed."""
    status = path.stat() if path.exists() else None
    return _read_version(path, None if status is None else (status.st_mtime_ns, status.st_size))


@lru_cache(maxsize=256)
def _read_version(path: Path, version: tuple[int, int] | None) -> World:
    return World.from_file(path)


@lru_cache(maxsize=256)
def _make_world(name: WorldName) -> World:
    part = _REGISTRY.find(name.part)
    takes = _taken_by(part)
    takes_seed, takes_difficulty = bool(takes - {"difficulty", "scale"}), "difficulty" in takes
    if name.seed is not None and not takes_seed:
        raise ValueError(f"world {name.part!r} takes no seed, got {name.seed}")
    if name.difficulty is not None and not takes_difficulty:
        raise ValueError(f"world {name.part!r} takes no difficulty, got {name.difficulty:g}")
    if callable(part):
        given = {"difficulty": name.difficulty, "scale": name.scale}
        make = partial(part, **{key: value for key, value in given.items() if value is not None})
        call = partial(_REGISTRY.call, name.part, make, *([name.seed or 0] if takes_seed else []))
        part = stored_layout(name, call) if name.part in WORLDS else call()
    if not isinstance(part, World):
        raise ValueError(
            f"world {name.part!r} must be a World or a function that returns one, got {type(part).__name__}"
        )
    return part


__all__ = [
    "WORLDS",
    "Obstacle",
    "Region",
    "Terrain",
    "World",
    "WorldName",
    "boulder",
    "box",
    "boxes",
    "cylinder",
    "cylinders",
    "get_world",
    "register_world",
    "with_walkers",
    "world_names",
]
