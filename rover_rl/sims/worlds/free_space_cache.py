"""Free space on disk, found by the content of the world and the robot that it was computed from."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from dataclasses import asdict, fields
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from rover_rl.sims import robots
from rover_rl.sims.robots import Robot
from rover_rl.sims.worlds.cache import content_key, load_arrays, store_arrays
from rover_rl.sims.worlds.obstacles import groups_of
from rover_rl.sims.worlds.world import World

if TYPE_CHECKING:
    from rover_rl.sims.worlds.free_space import FreeSpace

KIND = "free_space"
"""Folder of the cache."""


def load_free_space(kind: type[FreeSpace], world: World, robot: Robot) -> FreeSpace | None:
    """Returns the stored free space of a world for a robot.

    Returns ``None`` if it is not stored, the file is damaged, or another version of this package wrote it.
    """
    arrays = load_arrays(KIND, _key(world, robot))
    if arrays is None or set(arrays) != {field.name for field in fields(kind)}:
        return None
    values: dict[str, Any] = {name: torch.from_numpy(array) for name, array in arrays.items()}
    values["cell"] = float(arrays["cell"])
    values["origin"] = tuple(arrays["origin"].tolist())
    return kind(**values)


def store_free_space(world: World, robot: Robot, space: FreeSpace) -> None:
    """Stores the free space of a world for a robot. A full or read-only disk is no error."""
    values = {field.name: getattr(space, field.name) for field in fields(space)}
    arrays = {name: value.numpy() if isinstance(value, Tensor) else np.array(value) for name, value in values.items()}
    store_arrays(KIND, _key(world, robot), arrays)


def _key(world: World, robot: Robot) -> str:
    return content_key(_code(), _description(robot), *_content(world))


def _content(world: World) -> Iterator[bytes | str]:
    """Yields what the free space of a world depends on."""
    terrain = world.terrain
    yield repr((terrain.cell, terrain.origin, world.bounds, world.spawn_range, world.goal_range))
    tensors = [terrain.heights]
    for solids in groups_of(world.obstacles):
        tensors += [solids.vertices, solids.faces]
    for tensor in tensors:
        yield repr(tensor.shape)
        yield tensor.numpy().tobytes()


@lru_cache(maxsize=1)
def _code() -> bytes:
    """Hash of the modules that compute free space: what another version of them stored is not used."""
    digest = hashlib.sha256()
    for folder in (Path(__file__).parent, Path(robots.__file__).parent):
        for path in sorted(folder.glob("*.py")):
            digest.update(path.read_bytes())
    return digest.digest()


@lru_cache(maxsize=16)
def _description(robot: Robot) -> bytes:
    """Content of the description of a robot: its numbers and its URDF file, wherever that is."""
    numbers = {name: value for name, value in asdict(robot).items() if name not in ("name", "urdf")}
    return repr(numbers).encode() + robot.urdf.read_bytes()
