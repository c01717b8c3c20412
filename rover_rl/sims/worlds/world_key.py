"""Keys of worlds by their content, for results on disk that depend on a world."""

from __future__ import annotations

from collections.abc import Iterator
from weakref import WeakKeyDictionary

from rover_rl.sims.worlds.cache import content_key
from rover_rl.sims.worlds.obstacles import groups_of
from rover_rl.sims.worlds.world import World


def world_key(world: World) -> str:
    """Returns a key of the ground, the obstacles and the areas of a world."""
    key = _keys.get(world)
    if key is None:
        key = _keys[world] = content_key(*_content(world))
    return key


_keys: WeakKeyDictionary[World, str] = WeakKeyDictionary()


def _content(world: World) -> Iterator[bytes | str]:
    terrain = world.terrain
    yield repr((terrain.cell, terrain.origin, world.bounds, world.spawn_range, world.goal_range))
    tensors = [terrain.heights]
    for name in ("spawn_region", "goal_region"):
        region = getattr(world, name)
        if region is not None:
            yield repr((name, region.cell, region.origin))
            tensors.append(region.mask)
    for solids in groups_of(world.obstacles):
        tensors += [solids.vertices, solids.planes, solids.faces]
    for tensor in tensors:
        yield repr(tuple(tensor.shape))
        yield tensor.numpy().tobytes()
