"""The project's own world file, ``NAME.world.npz``: plain arrays and JSON."""

from __future__ import annotations

import json
import math
import zipfile
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from rover_rl.files import errors_name, written_whole
from rover_rl.sims.worlds.actor import Actor
from rover_rl.sims.worlds.files.assemble import WorldParts
from rover_rl.sims.worlds.files.suffixes import ARCHIVE_SUFFIX
from rover_rl.sims.worlds.obstacles import Obstacle
from rover_rl.sims.worlds.region import Region
from rover_rl.sims.worlds.terrain import Terrain

if TYPE_CHECKING:
    from rover_rl.sims.worlds.world import World

FORMAT = "rover_rl world, version 1"
"""Name of the file format."""
MAX_BYTES = 512 * 2**20
"""Largest size of the arrays of a file."""
ARRAYS = {"about": (1, "u1"), "heights": (2, "<f4"), "vertices": (2, "<f8"), "ends": (1, "<i8")}
"""Number of dimensions and type of each array: JSON text as bytes, the terrain, and the obstacles' vertices."""
REGIONS = ("spawn_region", "goal_region")
"""Regions, each an array of bytes with the cells of the mask, 0 or 1."""


def write_archive(world: World, path: Path) -> None:
    """Writes a world file, atomically.

    Raises:
        OSError: if the file cannot be written.
        ValueError: if the name does not end in ``.world.npz``.
    """
    if not path.name.endswith(ARCHIVE_SUFFIX):
        raise ValueError(f"the name of a world file must end in {ARCHIVE_SUFFIX}, got {path.name!r}")
    regions = {name: region for name in REGIONS if (region := getattr(world, name)) is not None}
    about = {
        "format": FORMAT,
        "name": world.name,
        "cell": world.terrain.cell,
        "origin": world.terrain.origin,
        "spawn_range": world.spawn_range,
        "goal_range": world.goal_range,
        "bounds": world.bounds,
        "spawn_height": world.spawn_height,
        "spawn_height_areas": world.spawn_height_areas,
        "actors": [asdict(actor) for actor in world.actors],
        "notes": world.notes,
        "regions": {name: (region.cell, region.origin) for name, region in regions.items()},
    }
    vertices = [obstacle.vertices.numpy() for obstacle in world.obstacles]
    arrays = {
        "about": np.frombuffer(json.dumps(about).encode(), dtype="u1"),
        "heights": world.terrain.heights.numpy().astype("<f4"),
        "vertices": np.concatenate([np.empty((0, 3)), *vertices]).astype("<f8"),
        "ends": np.cumsum([len(points) for points in vertices], dtype="<i8"),
        **{name: region.mask.numpy().astype("u1") for name, region in regions.items()},
    }
    with written_whole(path) as temporary, errors_name(path, temporary), temporary.open("wb") as file:
        np.savez_compressed(file, allow_pickle=False, **arrays)


def read_archive(path: Path) -> WorldParts:
    """Reads a world file.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if the file is damaged, too large, or of another format.
    """
    arrays = _read_arrays(path)
    try:
        about = json.loads(arrays["about"].tobytes())
        given = about["format"]
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise ValueError(f"{path} is no world file: its description cannot be read") from error
    if given != FORMAT:
        raise ValueError(f"{path} is a world file of the format {given!r}; this version of rover_rl reads {FORMAT!r}")
    try:
        return _parts(about, arrays)
    except (KeyError, TypeError, ValueError) as error:
        reason = f"{error} is missing" if isinstance(error, KeyError) else error
        raise ValueError(f"{path} is a damaged world file: {reason}") from error


def _parts(about: dict[str, Any], arrays: dict[str, np.ndarray]) -> WorldParts:
    ends = arrays["ends"]
    if len(ends) and (ends[-1] != len(arrays["vertices"]) or (np.diff(ends, prepend=0) < 4).any()):
        raise ValueError("the obstacles do not match their vertices")
    points = np.split(arrays["vertices"], ends[:-1]) if len(ends) else []
    terrain = Terrain(torch.from_numpy(arrays["heights"]), float(about["cell"]), _pair(about["origin"]))
    return WorldParts(
        name=str(about["name"]),
        terrain=terrain,
        obstacles=tuple(Obstacle(torch.from_numpy(part)) for part in points),
        spawn_range=_area(about["spawn_range"]),
        goal_range=_area(about["goal_range"]),
        bounds=_area(about["bounds"]),
        spawn_height=float(about["spawn_height"]),
        spawn_height_areas=tuple((_area(area), float(height)) for area, height in about["spawn_height_areas"]),
        actors=tuple(_actor(actor) for actor in about["actors"]),
        notes=tuple(str(note) for note in about["notes"]),
        **{name: _region(place, arrays[name]) for name, place in about["regions"].items() if name in REGIONS},
    )


def _region(place: Any, mask: np.ndarray) -> Region:
    cell, origin = place
    return Region(torch.from_numpy(mask > 0), float(cell), _pair(origin))


def _pair(values: Any) -> tuple[float, float]:
    low, high = (float(value) for value in values)
    if not (math.isfinite(low) and math.isfinite(high)):
        raise ValueError(f"{values} must be finite")
    return low, high


def _area(values: Any) -> tuple[tuple[float, float], tuple[float, float]]:
    x, y = values
    return _pair(x), _pair(y)


def _actor(data: dict[str, Any]) -> Actor:
    poses = tuple(tuple(float(number) for number in pose) for pose in data["poses"])
    return Actor(
        name=str(data["name"]),
        times=tuple(float(time) for time in data["times"]),
        poses=poses,  # type: ignore[arg-type]
        loop=bool(data["loop"]),
        delay_start=float(data["delay_start"]),
        auto_start=bool(data["auto_start"]),
    )


def _read_arrays(path: Path) -> dict[str, np.ndarray]:
    """Reads the arrays of a file and checks their types and sizes."""
    try:
        with zipfile.ZipFile(path) as archive:
            size = sum(info.file_size for info in archive.infolist())
        arrays = {}
        if size <= MAX_BYTES:
            with np.load(path, allow_pickle=False) as stored:
                arrays = {name: np.asarray(stored[name]) for name in (*ARRAYS, *REGIONS) if name in stored}
    except FileNotFoundError:
        raise
    # zipfile, zlib and NumPy raise errors without a common class.
    except Exception as error:
        raise ValueError(f"{path} is no world file, or a damaged one: {error}") from error
    if size > MAX_BYTES:
        raise ValueError(f"{path} unpacks to more than {MAX_BYTES >> 20} MB, which is more than a world has")
    for name, (dimensions, kind) in (ARRAYS | {name: (2, "u1") for name in REGIONS if name in arrays}).items():
        if name not in arrays:
            raise ValueError(f"{path} is no world file: it has no {name}")
        array = arrays[name]
        if array.dtype != np.dtype(kind) or array.ndim != dimensions or (name == "vertices" and array.shape[1] != 3):
            raise ValueError(f"{path} is no world file: its {name} have the shape {array.shape} and {array.dtype}")
    return arrays
