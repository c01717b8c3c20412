"""The project's own world file, ``NAME.world.npz``: plain arrays and JSON."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from rover_rl.files import errors_name, written_whole
from rover_rl.plain import from_plain, to_plain
from rover_rl.worlds import movers
from rover_rl.worlds.files.options import ARCHIVE_SUFFIX
from rover_rl.worlds.movers import Mover
from rover_rl.worlds.region import Area, Range, Region
from rover_rl.worlds.solids import Solids, hull
from rover_rl.worlds.terrain import Terrain

FORMAT = "rover_rl world, version 1"
ARRAYS = {"about": (1, "u1"), "heights": (2, "<f4"), "vertices": (2, "<f8"), "ends": (1, "<i8")}
"""Number of dimensions and type of each array: JSON text as bytes, the terrain, and the obstacles' vertices."""
REGIONS = {"spawn_region": (2, "u1"), "goal_region": (2, "u1")}
"""Arrays that a file may have: the cells of each region's mask, 0 or 1."""
FIELDS = ("name", "spawn_range", "goal_range", "bounds", "spawn_height", "spawn_height_areas", "notes")
"""Fields of a world that the description has under the same names."""
CLASSES = {name: kind for name, kind in vars(movers).items() if name in movers.__all__ and isinstance(kind, type)}
"""Motions and shapes of the package by name: a file names no others, so that reading one runs no other code."""


@dataclass(frozen=True)
class _About:
    """The description: format, :data:`FIELDS`, movers, and cell and origin of the terrain and of each region."""

    format: str
    name: str
    cell: float
    origin: Range
    spawn_range: Area
    goal_range: Area
    bounds: Area
    spawn_height: float
    spawn_height_areas: tuple[tuple[Area, float], ...]
    movers: tuple[dict[str, Any], ...]
    notes: tuple[str, ...]
    regions: dict[str, tuple[float, Range]]


def write_archive(world: Any, path: Path) -> None:
    """Writes a world file, atomically: that of :meth:`World.save`, whose module imports this one."""
    if not path.name.endswith(ARCHIVE_SUFFIX):
        raise ValueError(f"the name of a world file must end in {ARCHIVE_SUFFIX}, got {path.name!r}")
    regions = {name: region for name in REGIONS if (region := getattr(world, name)) is not None}
    about = _About(
        format=FORMAT,
        cell=world.terrain.cell,
        origin=world.terrain.origin,
        regions={name: (region.cell, region.origin) for name, region in regions.items()},
        movers=tuple(
            {"name": mover.name, "motion": _part_to_plain(mover.motion), "shape": _part_to_plain(mover.shape)}
            for mover in world.movers
        ),
        **{name: getattr(world, name) for name in FIELDS},
    )
    solids = Solids.of(world.obstacles)
    arrays = {
        "about": np.frombuffer(json.dumps(to_plain(about)).encode(), dtype="u1"),
        "heights": world.terrain.heights.numpy().astype("<f4"),
        "vertices": solids.vertices.numpy().astype("<f8"),
        "ends": np.array(solids.starts[1:], dtype="<i8"),
        **{name: region.mask.numpy().astype("u1") for name, region in regions.items()},
    }
    with written_whole(path) as temporary, errors_name(path, temporary), temporary.open("wb") as file:
        np.savez_compressed(file, allow_pickle=False, **arrays)


def read_archive(path: Path) -> dict[str, Any]:
    """Returns the fields of the world in a file. Files that are damaged or of another format are errors."""
    try:
        with np.load(path, allow_pickle=False) as stored:
            arrays = {name: np.asarray(stored[name]) for name in (*ARRAYS, *REGIONS) if name in stored}
    # zipfile, zlib and NumPy raise errors without a common class.
    except Exception as error:
        raise ValueError(f"{path} is no world file, or a damaged one: {error}") from error
    for name, (dimensions, kind) in (ARRAYS | {name: REGIONS[name] for name in arrays if name in REGIONS}).items():
        if name not in arrays:
            raise ValueError(f"{path} is no world file: it has no {name}")
        array = arrays[name]
        if array.dtype != np.dtype(kind) or array.ndim != dimensions or (name == "vertices" and array.shape[1] != 3):
            raise ValueError(f"{path} is no world file: its {name} have the shape {array.shape} and {array.dtype}")
    try:
        about = json.loads(arrays["about"].tobytes())
        given = about["format"]
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{path} is no world file: its description cannot be read") from error
    if given != FORMAT:
        raise ValueError(f"{path} is a world file of the format {given!r}; this version of rover_rl reads {FORMAT!r}")
    try:
        return _fields(from_plain(about, _About, "its description"), arrays)
    except (KeyError, TypeError, ValueError) as error:
        reason = f"{error} is missing" if isinstance(error, KeyError) else error
        raise ValueError(f"{path} is a damaged world file: {reason}") from error


def _fields(about: _About, arrays: dict[str, np.ndarray]) -> dict[str, Any]:
    ends, vertices = arrays["ends"], arrays["vertices"]
    if len(ends) and (ends[-1] != len(vertices) or (np.diff(ends, prepend=0) < 4).any()):
        raise ValueError("the obstacles do not match their vertices")
    terrain = Terrain(torch.from_numpy(arrays["heights"]), about.cell, about.origin)
    if not np.isfinite((terrain.extent, about.bounds, about.spawn_range, about.goal_range)).all():
        raise ValueError("the ground and the areas must be finite")
    places = {name: place for name, place in about.regions.items() if name in REGIONS}
    return {
        "terrain": terrain,
        "obstacles": [hull(part) for part in np.split(vertices, ends[:-1]) if len(ends)],
        "movers": tuple(
            Mover(_part_from_plain(each["motion"]), _part_from_plain(each["shape"]), str(each["name"]))
            for each in about.movers
        ),
        **{name: getattr(about, name) for name in FIELDS},
        **{name: Region(torch.from_numpy(arrays[name] > 0), *place) for name, place in places.items()},
    }


def _part_to_plain(part: Any) -> dict[str, Any]:
    name = type(part).__name__
    if CLASSES.get(name) is not type(part):
        raise ValueError(f"a world file can hold the motions and shapes of rover_rl alone, got {part!r}")
    return {"kind": name, **to_plain(part)}


def _part_from_plain(data: Any) -> Any:
    kind = CLASSES.get(str(data.get("kind"))) if isinstance(data, dict) else None
    if kind is None:
        raise ValueError(f"the kind of a motion or shape must be one of {sorted(CLASSES)}, got {data!r}")
    return from_plain({key: value for key, value in data.items() if key != "kind"}, kind, data["kind"])
