"""Layouts of the built-in generators on disk, found by the name of the world."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import scipy
import torch

from rover_rl.worlds.cache import code_key, content_key, load_arrays, store_arrays
from rover_rl.worlds.names import WorldName
from rover_rl.worlds.obstacles import Obstacle, Solids, groups_of
from rover_rl.worlds.terrain import Terrain
from rover_rl.worlds.world import World

KIND = "layouts"
SETTINGS = [field.name for field in fields(World) if field.name not in ("terrain", "obstacles", "movers")]
"""Fields of a world that are stored as JSON."""
PARTS = ("vertices", "planes", "faces", "outline")
"""Tensors of a group of solids, of which some groups have no outline."""


def stored_layout(name: WorldName, generate: Callable[[], World]) -> World:
    """Returns a world that is stored under its name, or generates and stores it."""
    folder = Path(__file__).parent
    # Other versions of NumPy and SciPy may generate other layouts.
    versions = f"{np.__version__} {scipy.__version__}"
    key = content_key(code_key(folder, folder / "generators"), versions, repr(name))
    arrays = load_arrays(KIND, key)
    if arrays is not None:
        return _unpack(arrays)
    world = generate()
    # Worlds with movers are simple, and generated as quickly as read.
    if not world.movers:
        store_arrays(KIND, key, _pack(world))
    return world


def _pack(world: World) -> dict[str, np.ndarray]:
    """Returns the content of a world as arrays of numbers."""
    about = [{name: getattr(world, name) for name in SETTINGS}, world.terrain.cell, world.terrain.origin]
    arrays = {
        "about": np.frombuffer(json.dumps(about).encode(), dtype=np.uint8),
        "heights": world.terrain.heights.numpy(),
    }
    for number, group in enumerate(groups_of(world.obstacles)):
        parts = ((part, getattr(group, part)) for part in PARTS)
        arrays |= {f"{part} {number}": tensor.numpy() for part, tensor in parts if tensor is not None}
    return arrays


def _unpack(arrays: dict[str, np.ndarray]) -> World:
    """Returns the world with the content of ``arrays``."""
    settings, cell, origin = (_tuples(part) for part in json.loads(arrays.pop("about").tobytes()))
    tensors = {name: torch.from_numpy(array) for name, array in arrays.items()}
    obstacles: list[Obstacle] = []
    number = 0
    while f"faces {number}" in tensors:
        group = (tensors.get(f"{part} {number}") for part in PARTS)
        obstacles += Solids(*group).obstacles()  # type: ignore[arg-type]  # Only the outline may be None.
        number += 1
    return World(terrain=Terrain(tensors["heights"], cell, origin), obstacles=obstacles, **settings)


def _tuples(value: Any) -> Any:
    """Returns a value from JSON with tuples in the place of lists."""
    if isinstance(value, dict):
        return {key: _tuples(part) for key, part in value.items()}
    return tuple(map(_tuples, value)) if isinstance(value, list) else value
