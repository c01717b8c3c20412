"""Layouts of the built-in generators on disk, found by the name of the world."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import scipy
import torch
from torch import Tensor

from rover_rl.sims.worlds.cache import code_key, content_key, load_arrays, store_arrays
from rover_rl.sims.worlds.names import WorldName
from rover_rl.sims.worlds.obstacles import Obstacle, Solids, groups_of
from rover_rl.sims.worlds.terrain import Terrain
from rover_rl.sims.worlds.world import World

KIND = "layouts"
"""Folder of the cache."""
SETTINGS = [field.name for field in fields(World) if field.name not in ("terrain", "obstacles")]
"""Fields of a world that are stored as JSON. Generated worlds have no actors, which JSON does not take."""
PARTS = ("vertices", "planes", "faces", "outline")
"""Tensors of a group of solids."""


def stored_layout(name: WorldName, generate: Callable[[], World]) -> World:
    """Returns a world that is stored under its name, or generates and stores it.

    Args:
        name: name of a world of a built-in generator.
        generate: generates the world.
    """
    folder = Path(__file__).parent
    # Other versions of NumPy and SciPy may generate other layouts.
    versions = f"{np.__version__} {scipy.__version__}"
    key = content_key(code_key(folder, folder / "generators"), versions, repr(name))
    arrays = load_arrays(KIND, key)
    if arrays is not None:
        return _unpack(arrays)
    world = generate()
    store_arrays(KIND, key, _pack(world))
    return world


def _pack(world: World) -> dict[str, np.ndarray]:
    """Returns the content of a world as arrays of numbers."""
    groups = groups_of(world.obstacles)
    parts = {name: [_array(getattr(group, name)) for group in groups] for name in PARTS}
    about = {
        "settings": {name: getattr(world, name) for name in SETTINGS},
        "ground": (world.terrain.cell, world.terrain.origin),
        "shapes": {name: [array.shape for array in arrays] for name, arrays in parts.items()},
    }
    return {
        "about": np.frombuffer(json.dumps(about).encode(), dtype=np.uint8),
        "heights": world.terrain.heights.numpy(),
        **{name: np.concatenate([_array(None), *map(np.ravel, arrays)]) for name, arrays in parts.items()},
    }


def _array(tensor: Tensor | None) -> np.ndarray:
    """Returns a tensor of a group of solids as an array, which is empty for a group without an outline."""
    return np.zeros(0, dtype=np.int64) if tensor is None else tensor.numpy()


def _unpack(arrays: dict[str, np.ndarray]) -> World:
    """Returns the world with the content of ``arrays``."""
    about = json.loads(arrays["about"].tobytes())
    parts = [_split(arrays[name], about["shapes"][name]) for name in PARTS]
    obstacles: list[Obstacle] = []
    for vertices, planes, faces, outline in zip(*parts, strict=True):
        obstacles += Solids(vertices, planes, faces, outline if len(outline) else None).obstacles()
    cell, origin = about["ground"]
    terrain = Terrain(torch.from_numpy(arrays["heights"]), cell, tuple(origin))
    settings = {name: _tuples(value) for name, value in about["settings"].items()}
    return World(terrain=terrain, obstacles=obstacles, **settings)


def _split(flat: np.ndarray, shapes: list[list[int]]) -> list[Tensor]:
    """Returns the tensors with the given shapes that follow one another in ``flat``."""
    ends = np.cumsum([math.prod(shape) for shape in shapes], dtype=np.int64)
    parts = np.split(flat, ends[:-1]) if shapes else []
    return [torch.from_numpy(part.reshape(shape)) for part, shape in zip(parts, shapes, strict=True)]


def _tuples(value: Any) -> Any:
    """Returns a value from JSON with tuples in the place of lists."""
    return tuple(map(_tuples, value)) if isinstance(value, list) else value
