"""Worlds: terrain, obstacles, and areas of the task. They know no robot."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from inspect import signature
from pathlib import Path

from rover_rl.names import Name
from rover_rl.registry import Registry
from rover_rl.worlds.files.options import is_world_file
from rover_rl.worlds.generators import WORLDS
from rover_rl.worlds.generators.crowds import with_walkers
from rover_rl.worlds.region import Region
from rover_rl.worlds.solids import Solids, boulder, box, boxes, cylinder, cylinders, hull
from rover_rl.worlds.terrain import Terrain
from rover_rl.worlds.world import World

__all__ = ["WORLDS", "get_world", "register_world", "takes_scale", "with_walkers", "world_names"]
__all__ += ["Region", "Solids", "Terrain", "World", "boulder", "box", "boxes", "cylinder", "cylinders", "hull"]

_REGISTRY = Registry(
    "world",
    WORLDS,
    also=", 'name:seed', 'name:seed@difficulty', the path of a file, a World, or 'module:attribute' of your own",
)


def register_world(name: str, world: World | Callable[..., World] | str) -> None:
    """Registers a world under a name, for ``world_n``, ``EnvConfig`` and ``--world``.

    Args:
        name: new name of letters, digits, ``_``, ``-`` and ``.``.
        world: world, function that returns a world and takes a seed (int), optionally also ``difficulty``, ``scale``
            and further settings, or no argument, or ``"module:attribute"`` of either.

    Raises:
        ValueError: if the name is taken or has other characters.

    Example:
        >>> register_world("canyon", lambda seed: World(f"canyon-{seed}", Terrain.flat((18, 18))))
        >>> get_world("canyon:3").name
        'canyon-3'
    """
    _REGISTRY.register(name, world)


def world_names() -> list[str]:
    """Names of all worlds: built-in, registered, and from installed packages."""
    return _REGISTRY.names()


def get_world(world: str | World) -> World:
    """Returns a world by name. Returns a :class:`World` unchanged.

    Args:
        world: name in :func:`world_names`, ``"module:attribute"`` of a world or of a function that returns one, path of
            a world file (:meth:`World.from_file`), or a world. Settings follow as in every
            :class:`~rover_rl.names.Name`: ``"maze:7"`` is another layout, ``"maze:7@0.2"`` an easier one,
            ``"maze:7*1.6"`` the same one with wider passages for larger robots, ``"moon(size=16)"`` a larger one, and
            in ``"maze+walkers:7@0.3"`` and ``"yard.yaml+walkers"`` people walk. The same name returns the same object
            (the last 256 names are cached).

    Raises:
        FileNotFoundError: if the name is a path, and there is no such file.
        ValueError: if the name is unknown, that of a range, or that of something else than a world, or if the world
            does not take one of its settings.
    """
    if isinstance(world, World):
        return world
    name = Name.parse(str(world))
    if name.is_range:
        raise ValueError(f"{str(world)!r} names {len(name)} worlds; name one of them, such as {str(name[0])!r}")
    if name.part in WORLDS:
        name = name.replace(seed=name.settings.get("seed", 0))
    if name.settings.get("scale") == 1:
        name = name.replace(scale=None)
    path, version = Path(name.part), None
    if is_world_file(name.part) and path.exists():
        # A file is read again after it has changed.
        name, version = Name(str(path.resolve()), name.settings), (path.stat().st_mtime_ns, path.stat().st_size)
    return _make(name, version)


def takes_scale(world: str) -> bool:
    """Whether a name is that of a world, or of a range, that can have a scale, and states none."""
    name = Name.parse(world)
    if "scale" in name.settings or is_world_file(name.part):
        return False
    return name.part in WORLDS or "scale" in _parameters(name.part)


def _parameters(part: str) -> list[str]:
    found = None if is_world_file(part) else _REGISTRY.find(part)
    return [*signature(found).parameters] if callable(found) else []


@lru_cache(maxsize=256)
def _make(name: Name, version: tuple[int, int] | None) -> World:
    settings, takes = dict(name.settings), _parameters(name.part)
    takes_seed = next((setting for setting in takes if setting not in ("difficulty", "scale")), None)
    if settings.pop("walkers", False):
        # Seed and difficulty are those of the people, and of the world if it takes them.
        foreign = {"difficulty": "difficulty" in takes, "seed": takes_seed is not None}
        world = get_world(str(name.replace(walkers=None, **{key: None for key, own in foreign.items() if not own})))
        return with_walkers(world, **{key: settings[key] for key in foreign if key in settings})
    if "scale" in settings and name.part in WORLDS and "scale" not in takes:
        return get_world(str(name.replace(scale=None))).scaled(settings["scale"])
    for setting, value in settings.items():
        if setting not in takes and not (setting == "seed" and takes_seed):
            raise ValueError(f"world {name.part!r} takes no {setting}, got {value}")
    if is_world_file(name.part):
        return World.from_file(name.part)
    made = _REGISTRY.find(name.part)
    if callable(made):
        seed = [settings.pop("seed", 0)] if takes_seed else []
        made = _REGISTRY.call(name.part, made, *seed, **settings)
    if isinstance(made, World):
        return made
    raise ValueError(f"world {name.part!r} must be a World or a function that returns one, got {type(made).__name__}")
