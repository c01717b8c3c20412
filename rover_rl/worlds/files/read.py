"""Reading of world files of all formats."""

from __future__ import annotations

import warnings
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from rover_rl.option_names import written
from rover_rl.progress import ProgressDisplay
from rover_rl.worlds.files import ELEVATION_SUFFIXES, MAP_SUFFIXES, SDF_SUFFIXES, SUFFIXES
from rover_rl.worlds.files.archive import read_archive
from rover_rl.worlds.files.areas import find_areas
from rover_rl.worlds.files.contents import Contents, Piece, Plane, listed
from rover_rl.worlds.files.convex import check_triangles, obstacles_of
from rover_rl.worlds.files.elevation import read_elevation
from rover_rl.worlds.files.ground import (
    HIGHEST_SLAB,
    STEP,
    Ground,
    floors_on,
    ground_pieces,
    height_over,
    is_flat,
    make_terrain,
)
from rover_rl.worlds.files.mesh_files import read_mesh
from rover_rl.worlds.files.occupancy import read_map
from rover_rl.worlds.files.options import ImportOptions, make_options
from rover_rl.worlds.files.sdf import read_sdf
from rover_rl.worlds.files.triangles import split
from rover_rl.worlds.region import Area
from rover_rl.worlds.solids import Solids
from rover_rl.worlds.terrain import Terrain

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
        return read_map(path, chosen) if suffix in MAP_SUFFIXES else _assemble(_contents(path, chosen), chosen, display)


def _contents(path: Path, options: ImportOptions) -> Contents:
    suffix = path.suffix.lower()
    if suffix in SDF_SUFFIXES:
        return read_sdf(path, options)
    if suffix in ELEVATION_SUFFIXES:
        return read_elevation(path, options)
    return Contents(path.name.partition(".")[0], read_mesh(path, options.up, options.scale))


def _assemble(contents: Contents, options: ImportOptions, display: ProgressDisplay) -> dict[str, Any]:
    parts = [(piece, split(piece)) for piece in contents.pieces]
    pieces = [part for _, found in parts for part in found]
    left_out = [*contents.left_out, *_without_area(piece.name for piece, found in parts if not found)]
    if not pieces and not contents.planes and not contents.grids:
        raise ValueError(f"{contents.name} holds no ground and no obstacles")
    if len(pieces) > MAX_PIECES:
        raise ValueError(f"{contents.name} has {len(pieces):,} separate pieces; at most {MAX_PIECES:,} are supported")
    surfaces = ground_pieces(pieces, options.ground, has_base=bool(contents.planes or contents.grids))
    chosen = {id(surface.piece) for surface in surfaces}
    others = [piece for piece in pieces if id(piece) not in chosen]
    planes, notes = contents.planes, [*contents.notes]
    if not surfaces and not planes and not contents.grids:
        lowest = min(float(piece.vertices[:, 2].min()) for piece in pieces)
        planes = [Plane.level(lowest)]
        notes.append(f"ground: no piece is ground, so that the ground is flat at the lowest point, {lowest:.2f} m")
    if surfaces:
        notes.append(f"ground: {listed(surface.piece.name for surface in surfaces)}")
    ground = Ground(planes, contents.grids, surfaces)
    around = _around(others, ground, options)
    terrain, about_ground = make_terrain(ground, around, options.cell)
    floors = floors_on(terrain, others) if options.ground == "auto" else []
    if floors:
        notes.append(f"ground: floors of at most 5 cm on other ground: {listed(floor.piece.name for floor in floors)}")
        ground = Ground(planes, contents.grids, [*surfaces, *floors])
        terrain, about_ground = make_terrain(ground, around, options.cell)
        others = [piece for piece in others if all(piece is not floor.piece for floor in floors)]
    obstacles, buried, bad = _obstacles(others, terrain, options, display)
    if bad and not obstacles and not surfaces and not contents.planes and not contents.grids:
        raise ValueError(bad[0])
    left_out += [f"left out: {sentence}" for sentence in bad]
    for sentence in left_out:
        warnings.warn(f"{contents.name}: {sentence}", stacklevel=4)
    display.update(1.0, "starts and goals")
    about_pieces = (
        [f"obstacles: {buried} pieces that end at most 1 cm above the ground were left out"] if buried else []
    )
    areas, about_areas = _areas(others, terrain, obstacles, options, _limits(around, ground, terrain))
    return {
        "name": options.name or contents.name,
        "terrain": terrain,
        "obstacles": obstacles,
        **areas,
        "movers": tuple(contents.movers),
        "notes": (*left_out, *notes, *about_ground, *about_pieces, *about_areas),
    }


def _areas(
    pieces: list[Piece], terrain: Terrain, obstacles: list[Solids], options: ImportOptions, limits: Area
) -> tuple[dict[str, Any], list[str]]:
    try:
        return find_areas(terrain, obstacles, options, limits)
    except ValueError as error:
        low = [p.name for p in pieces if is_flat(p) and STEP < height_over(terrain, p) <= HIGHEST_SLAB]
        if not low:
            raise
        ground = written("ground", low[0].partition("/")[0] + "*")
        raise ValueError(f"{error}; if some of {listed(low)} are ground, name them, such as {ground}") from error


def _without_area(names: Iterable[str]) -> list[str]:
    named = listed(names)
    return [f"left out, as their triangles have no area: {named}"] if named else []


def _around(pieces: list[Piece], ground: Ground, options: ImportOptions) -> np.ndarray:
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


def _limits(around: np.ndarray, ground: Ground, terrain: Terrain) -> Area:
    points = np.concatenate((around, ground.corners(around)))
    (x_low, y_low), (x_high, y_high) = points.min(0), points.max(0)
    (left, right), (bottom, top) = terrain.extent
    return (max(float(x_low), left), min(float(x_high), right)), (max(float(y_low), bottom), min(float(y_high), top))


def _obstacles(
    pieces: list[Piece], terrain: Terrain, options: ImportOptions, display: ProgressDisplay
) -> tuple[list[Solids], int, list[str]]:
    obstacles: list[Solids] = []
    bad: list[str] = []
    buried = triangles = 0
    for number, piece in enumerate(pieces):
        display.update(number / len(pieces), f"obstacle {number + 1:,} of {len(pieces):,}: {piece.name}")
        if height_over(terrain, piece) <= STEP + 1e-6:
            buried += 1
            continue
        try:
            solids = obstacles_of(piece, options.obstacle_error)
        except ValueError as error:
            bad.append(str(error))
            continue
        obstacles += solids
        triangles += sum(len(solid.faces) for solid in solids)
        check_triangles(triangles)
    return obstacles, buried, bad
