"""Free space on disk, found by the content of the world and the robot that it was computed from."""

from __future__ import annotations

from dataclasses import asdict
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from rover_rl.sims import robots, worlds
from rover_rl.sims.free_space.cell_grid import CellGrid
from rover_rl.sims.robots import Robot
from rover_rl.sims.worlds.cache import code_key, content_key, load_arrays, store_arrays, world_key
from rover_rl.sims.worlds.region import overlap
from rover_rl.sims.worlds.world import World

if TYPE_CHECKING:
    from rover_rl.sims.free_space.space import FreeSpace

KIND = "free_space"
"""Folder of the cache."""
CELLS = ("spawn_cells", "goal_cells")
"""Lists of cells, which are stored as booleans of the grid."""


def load_free_space(kind: type[FreeSpace], world: World, robot: Robot) -> FreeSpace | None:
    """Returns the stored free space of a world for a robot.

    Returns ``None`` if it is not stored, or the file is damaged.
    """
    arrays = load_arrays(KIND, _key(world, robot))
    if arrays is None:
        return None
    grid = CellGrid(overlap(world.bounds, world.terrain.extent))
    cells = {name: grid.centers(arrays.pop(name)) for name in CELLS}
    return kind(grid.cell, grid.origin, **cells, **{name: torch.from_numpy(array) for name, array in arrays.items()})


def store_free_space(world: World, robot: Robot, space: FreeSpace) -> None:
    """Stores the free space of a world for a robot. A full or read-only disk is no error."""
    arrays = {name: value.numpy() for name, value in vars(space).items() if isinstance(value, Tensor)}
    grid = CellGrid(overlap(world.bounds, world.terrain.extent))
    arrays |= {name: grid.marked(getattr(space, name)) for name in CELLS}
    store_arrays(KIND, _key(world, robot), arrays)


def _key(world: World, robot: Robot) -> str:
    folders = (Path(module).parent for module in (__file__, worlds.__file__, robots.__file__))
    return content_key(code_key(*folders), _description(robot), world_key(world))


@lru_cache(maxsize=16)
def _description(robot: Robot) -> bytes:
    """Content of the description of a robot: its numbers and its URDF file, wherever that is."""
    numbers = {name: value for name, value in asdict(robot).items() if name not in ("name", "urdf")}
    return repr(numbers).encode() + robot.urdf.read_bytes()
