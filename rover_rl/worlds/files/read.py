"""Reading of world files of all formats."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import numpy as np

from rover_rl.option_names import written
from rover_rl.progress import ProgressDisplay
from rover_rl.worlds.files import ground as grounds
from rover_rl.worlds.files.archive import read_archive
from rover_rl.worlds.files.areas import find_areas
from rover_rl.worlds.files.contents import Contents, Piece, Plane, listed
from rover_rl.worlds.files.convex import obstacles_of
from rover_rl.worlds.files.elevation import read_elevation
from rover_rl.worlds.files.occupancy import read_map
from rover_rl.worlds.files.options import (
    ELEVATION_SUFFIXES,
    MAP_SUFFIXES,
    MAX_TRIANGLES,
    SDF_SUFFIXES,
    SUFFIXES,
    ImportOptions,
    make_options,
)
from rover_rl.worlds.files.sdf import read_sdf
from rover_rl.worlds.files.triangles import read_mesh, split
from rover_rl.worlds.solids import Solids

MAX_PIECES = 50_000
EMPTY_SIDE = 20.0
"""Largest side of the area of an empty plane, m."""


def read_world(path: Path, **options: Any) -> dict[str, Any]:
    """Returns the fields of the world in a file. See :meth:`rover_rl.World.from_file`."""
    chosen = make_options(options)
    if not path.is_file():
        raise FileNotFoundError(f"there is no world file {path}")
    suffix = path.suffix.lower()
    if suffix == ".npz":
        if options:
            given = [written(name) for name in sorted(options)]
            raise ValueError(f"{path} is imported already: give {given} when it is imported")
        return read_archive(path)
    if suffix not in SUFFIXES:
        raise ValueError(f"{path} is no world file; use one of {[*SUFFIXES]}")
    # Convex decomposition of large meshes takes minutes, and that of others no time.
    with ProgressDisplay(f"importing {path.name}", estimate=False) as display:
        if suffix in MAP_SUFFIXES:
            return read_map(path, chosen)
        if suffix in SDF_SUFFIXES:
            contents = read_sdf(path, chosen)
        elif suffix in ELEVATION_SUFFIXES:
            contents = read_elevation(path, chosen)
        else:
            contents = Contents(path.name.partition(".")[0], read_mesh(path, chosen.up, chosen.scale))
        return _assemble(contents, chosen, display)


def _assemble(contents: Contents, options: ImportOptions, display: ProgressDisplay) -> dict[str, Any]:
    planes, grids, notes = contents.planes, contents.grids, [*contents.notes]
    parts = [(piece, split(piece)) for piece in contents.pieces]
    pieces = [part for _, found in parts for part in found]
    if empty := listed(piece.name for piece, found in parts if not found):
        contents.left_out.append(f"left out, as their triangles have no area: {empty}")
    has_base = bool(planes or grids)
    if not pieces and not has_base:
        raise ValueError(f"{contents.name} holds no ground and no obstacles")
    if len(pieces) > MAX_PIECES:
        raise ValueError(f"{contents.name} has {len(pieces):,} separate pieces; at most {MAX_PIECES:,} are supported")
    surfaces = grounds.ground_pieces(pieces, options.ground, has_base)
    if surfaces:
        notes.append(f"ground: {listed(surface.piece.name for surface in surfaces)}")
    elif not has_base:
        lowest = min(float(piece.vertices[:, 2].min()) for piece in pieces)
        planes = [Plane(np.array((0.0, 0.0, lowest)))]
        notes.append(f"ground: no piece is ground, so that the ground is flat at the lowest point, {lowest:.2f} m")
    others = _without(pieces, surfaces)
    ground = grounds.Ground(planes, grids, surfaces)
    around = _around(others, ground, options)
    terrain, about_ground = grounds.make_terrain(ground, around, options.cell)
    floors = [grounds.Surface.of(piece) for piece in others if grounds.is_floor(terrain, piece)]
    if floors and options.ground == "auto":
        notes.append(f"ground: floors of at most 5 cm on other ground: {listed(floor.piece.name for floor in floors)}")
        ground = grounds.Ground(planes, grids, [*surfaces, *floors])
        terrain, about_ground = grounds.make_terrain(ground, around, options.cell)
        others = _without(others, floors)
    raised = [piece for piece in others if grounds.height_over(terrain, piece) > grounds.STEP + 1e-6]
    obstacles, wrong = _obstacles(raised, options, display)
    if wrong and not (obstacles or surfaces or has_base):
        raise ValueError(wrong[0])
    left_out = [*contents.left_out, *(f"left out: {sentence}" for sentence in wrong)]
    for sentence in left_out:
        warnings.warn(f"{contents.name}: {sentence}", stacklevel=4)
    if buried := len(others) - len(raised):
        about_ground.append(f"obstacles: {buried} pieces that end at most 1 cm above the ground were left out")
    display.update(1.0, "starts and goals")
    points = np.concatenate((around, ground.corners(around)))
    x, y = (
        (max(float(low), least), min(float(high), most))
        for low, high, (least, most) in zip(points.min(0), points.max(0), terrain.extent, strict=True)
    )
    try:
        areas, about_areas = find_areas(terrain, obstacles, options, (x, y))
    except ValueError as error:
        low = [piece.name for piece in others if grounds.is_low(terrain, piece)]
        if not low:
            raise
        named = written("ground", low[0].partition("/")[0] + "*")
        raise ValueError(f"{error}; if some of {listed(low)} are ground, name them, such as {named}") from error
    return {
        "name": options.name or contents.name,
        "terrain": terrain,
        "obstacles": obstacles,
        **areas,
        "movers": tuple(contents.movers),
        "notes": (*left_out, *notes, *about_ground, *about_areas),
    }


def _without(pieces: list[Piece], surfaces: list[grounds.Surface]) -> list[Piece]:
    chosen = {id(surface.piece) for surface in surfaces}
    return [piece for piece in pieces if id(piece) not in chosen]


def _around(pieces: list[Piece], ground: grounds.Ground, options: ImportOptions) -> np.ndarray:
    """Returns the points around which a plane is laid out: ``[P, 2]``, m."""
    points = [piece.vertices[:, :2] for piece in pieces]
    for place in (options.spawn_range, options.goal_range, options.bounds):
        if place is not None:
            numbers = np.array(place)
            points.append(numbers.T if numbers.shape == (2, 2) else numbers.reshape(-1, 2))
    if not points and not ground.grids and not ground.surfaces:
        for plane in ground.planes:
            half = np.minimum(np.array(plane.size), EMPTY_SIDE) / 2
            points.append(plane.point[:2] + np.stack((-half, half)))
    return np.concatenate([np.empty((0, 2)), *points])


def _obstacles(pieces: list[Piece], options: ImportOptions, display: ProgressDisplay) -> tuple[list[Solids], list[str]]:
    """Returns the convex solids in place of pieces, and what is wrong with those that have none."""
    obstacles: list[Solids] = []
    wrong: list[str] = []
    triangles = 0
    for number, piece in enumerate(pieces):
        display.update(number / len(pieces), f"obstacle {number + 1:,} of {len(pieces):,}: {piece.name}")
        try:
            solids = obstacles_of(piece, options.obstacle_error)
        except ValueError as error:
            wrong.append(str(error))
            continue
        obstacles += solids
        triangles += sum(len(solid.faces) for solid in solids)
        if triangles > MAX_TRIANGLES:
            raise ValueError(
                f"the obstacles have more than {MAX_TRIANGLES:,} triangles, which the simulators do not take; simplify "
                f"the meshes, or accept a larger {written('obstacle_error')}"
            )
    return obstacles, wrong
