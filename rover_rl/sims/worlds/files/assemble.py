"""From what a file holds to the parts of a world."""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import numpy as np
import torch

from rover_rl.option_names import written
from rover_rl.progress import ProgressDisplay
from rover_rl.sims.worlds.actor import Actor
from rover_rl.sims.worlds.files.areas import find_areas
from rover_rl.sims.worlds.files.components import split
from rover_rl.sims.worlds.files.contents import Contents, Piece, Plane, listed
from rover_rl.sims.worlds.files.ground import ground_pieces
from rover_rl.sims.worlds.files.hulls import obstacles_of
from rover_rl.sims.worlds.files.options import ImportOptions
from rover_rl.sims.worlds.files.terrain import Ground, make_terrain
from rover_rl.sims.worlds.obstacles import Obstacle
from rover_rl.sims.worlds.region import Area, Region
from rover_rl.sims.worlds.terrain import Terrain

MAX_PIECES = 50_000
"""Largest number of connected pieces of a world."""
MAX_TRIANGLES = 170_000
"""Largest number of triangles of all obstacles: Bullet's limit for the mesh that takes the lidar rays."""
EMPTY_SIDE = 20.0
"""Largest side of the area of an empty plane, m."""


@dataclass(frozen=True)
class WorldParts:
    """The parts of a world, named as the arguments of :class:`rover_rl.World`."""

    name: str
    terrain: Terrain
    obstacles: tuple[Obstacle, ...]
    spawn_range: Area
    goal_range: Area
    bounds: Area
    spawn_height: float = 0.75
    spawn_height_areas: tuple[tuple[Area, float], ...] = ()
    actors: tuple[Actor, ...] = ()
    notes: tuple[str, ...] = ()
    spawn_region: Region | None = None
    goal_region: Region | None = None


def assemble(contents: Contents, options: ImportOptions, display: ProgressDisplay) -> WorldParts:
    """Turns the contents of a file into the parts of a world.

    Args:
        contents: what a reader found in the file.
        options: options of the import.
        display: shows how many obstacles are done.

    Raises:
        ValueError: if there is nothing in the file, no free ground, or more than the simulators take.
    """
    for sentence in contents.left_out:
        warnings.warn(f"{contents.name}: {sentence}", stacklevel=4)
    pieces = [part for piece in contents.pieces for part in split(piece)]
    if not pieces and not contents.planes and not contents.grids:
        raise ValueError(f"{contents.name} holds no ground and no obstacles")
    if len(pieces) > MAX_PIECES:
        raise ValueError(f"{contents.name} has {len(pieces):,} separate pieces; at most {MAX_PIECES:,} are supported")
    surfaces = ground_pieces(pieces, options.ground, has_base=bool(contents.planes or contents.grids))
    chosen = {id(surface.piece) for surface in surfaces}
    others = [piece for piece in pieces if id(piece) not in chosen]
    planes, notes = contents.planes, list(contents.notes)
    if not surfaces and not planes and not contents.grids:
        lowest = min(float(piece.vertices[:, 2].min()) for piece in pieces)
        planes = [Plane(np.array((0.0, 0.0, lowest)), np.array((0.0, 0.0, 1.0)), (0.0, 0.0))]
        notes.append(f"ground: no piece is ground, so that the ground is flat at the lowest point, {lowest:.2f} m")
    if surfaces:
        notes.append(f"ground: {listed(surface.piece.name for surface in surfaces)}")
    ground = Ground(planes, contents.grids, surfaces)
    around = _around(others, ground, options)
    terrain, about = make_terrain(ground, around, options.cell)
    obstacles, buried = _obstacles(others, terrain, options, display)
    notes += about + ([f"obstacles: {buried} pieces below the ground were left out"] if buried else [])
    areas, about = find_areas(terrain, obstacles, options, _limits(around, ground, terrain))
    notes += about
    return WorldParts(
        name=options.name or contents.name,
        terrain=terrain,
        obstacles=tuple(obstacles),
        **vars(areas),
        actors=tuple(contents.actors),
        notes=(*contents.left_out, *notes),
    )


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
    return np.concatenate(points) if points else np.empty((0, 2))


def _limits(around: np.ndarray, ground: Ground, terrain: Terrain) -> Area:
    """Returns the area that holds obstacles, or ground with an end."""
    points = np.concatenate((around, ground.corners()))
    if ground.planes and len(around):
        points = np.concatenate((points, around - 3.0, around + 3.0))
    (x_low, y_low), (x_high, y_high) = points.min(0), points.max(0)
    (left, right), (bottom, top) = terrain.extent
    return (max(float(x_low), left), min(float(x_high), right)), (max(float(y_low), bottom), min(float(y_high), top))


def _obstacles(
    pieces: list[Piece], terrain: Terrain, options: ImportOptions, display: ProgressDisplay
) -> tuple[list[Obstacle], int]:
    """Returns the obstacles, and the number of pieces that were left out because they are below the ground."""
    obstacles: list[Obstacle] = []
    buried = triangles = 0
    for number, piece in enumerate(pieces):
        display.update(number / len(pieces), f"obstacle {number + 1:,} of {len(pieces):,}: {piece.name}")
        points = torch.from_numpy(np.concatenate((piece.vertices, piece.vertices.mean(0, keepdims=True))))
        if bool((points[:, 2] < terrain.height_at(points[:, :2])).all()):
            buried += 1
            continue
        for obstacle in obstacles_of(piece, options.obstacle_error):
            obstacles.append(obstacle)
            triangles += len(obstacle.faces)
        check_triangles(triangles)
    return obstacles, buried


def check_triangles(triangles: int) -> None:
    """Checks the number of triangles of all obstacles.

    Raises:
        ValueError: if the simulators do not take that many.
    """
    if triangles > MAX_TRIANGLES:
        raise ValueError(
            f"the obstacles have more than {MAX_TRIANGLES:,} triangles, which the simulators do not take; simplify the "
            f"meshes, or accept a larger {written('obstacle_error')}"
        )
