"""Ground of an imported world: tells ground and obstacles apart, and makes one grid of heights of all ground."""

from __future__ import annotations

import math
from dataclasses import dataclass
from fnmatch import fnmatchcase

import numpy as np
import torch
from scipy.ndimage import distance_transform_edt, map_coordinates

from rover_rl.worlds.files.contents import Grid, Piece, Plane
from rover_rl.worlds.files.triangles import convex_hull, face_normals, is_closed, ray_distances, signed_volume
from rover_rl.worlds.solids import hull
from rover_rl.worlds.terrain import Terrain

STEEPEST = 0.17
"""Least z component of the unit normal of a face that counts as ground (80 degrees)."""
COMPARED = 256
"""Number of cells along the longer side of the grid on which pieces are compared."""
THICKEST = 0.5
"""Largest height of a ground piece, in its shorter horizontal side."""
LEAST_SURFACE = 0.2
"""Least share of a ground piece's bounding rectangle that its surface covers, seen from above."""
LEAST_COVER = 0.25
"""Least share of the scene's bounding rectangle that ground covers, or else there is none."""
HIGHEST_SLAB, LEAST_AREA = 0.5, 16.0
"""Largest height (m) of a simple shape that is ground on top of a plane or an elevation grid, and its least area."""
STEP = 0.01
"""Difference in height from which one piece is below another, m."""
HIGHEST_FLOOR = 0.05
"""Largest height of a floor, such as a carpet, over the ground that it lies on, m."""
NARROWEST_FLOOR, SMALLEST_FLOOR = 0.5, 1.0
"""Least width (m) and area (m^2) of a floor on other ground. The foot of a table is smaller."""
MAX_VALUES = 4_000_000
CELLS, FLAT_CELL = (0.1, 0.05, 0.025), 1.0
"""Spacings that are tried for meshes, and that of flat ground, m."""
GOOD = 0.01
"""Accepted error of the ground for 99 % of it, m."""
SURROUNDINGS = 15.0
"""Width of a plane around the obstacles, beyond the range of the lidar, m."""


@dataclass(frozen=True)
class Surface:
    """The upward faces of a piece, that a wheel could stand on. Both sides of an open surface count."""

    piece: Piece
    vertices: np.ndarray
    faces: np.ndarray

    @classmethod
    def of(cls, piece: Piece) -> Surface:
        vertices, faces = piece.vertices, piece.faces
        if faces is None and convex_hull(vertices) is None:
            faces = np.empty((0, 3), dtype=int)
        elif faces is None:
            solid = hull(vertices)
            vertices, faces = solid.vertices.numpy(), solid.faces.numpy()
        closed = is_closed(faces)
        if closed and signed_volume(vertices, faces) < 0:
            faces = faces[:, ::-1]
        normal = face_normals(vertices, faces)
        length = np.linalg.norm(normal, axis=1)
        up = normal[:, 2] if closed else np.abs(normal[:, 2])
        return cls(piece, vertices, faces[(length > 1e-12) & (up > STEEPEST * length)])

    def heights(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Returns the lowest height at each of some points, m, NaN where there is no triangle."""
        bottom = self.vertices[:, 2].min() - 1.0
        starts = np.stack((x, y, np.full_like(x, bottom)), -1).reshape(-1, 3)
        return bottom + ray_distances(starts, (0.0, 0.0, 1.0), self.vertices, self.faces).reshape(x.shape)

    @property
    def covers(self) -> bool:
        """Whether the surface, seen from above, covers enough of its bounding rectangle for ground."""
        x, y, _ = np.ptp(self.vertices, axis=0)
        area = np.abs(face_normals(self.vertices, self.faces)[:, 2]).sum() / 2
        return bool(area >= LEAST_SURFACE * x * y)


def ground_pieces(pieces: list[Piece], wanted: str, has_base: bool) -> list[Surface]:
    """Returns the pieces that are ground.

    Automatically, a piece is a candidate if it is broad: at most half as high as its shorter side, and its upward
    faces cover a fifth of its bounding rectangle. Seen from below, a candidate is ground if it is the lowest one over
    at least half of its own area, and most other pieces above or below it do not end below it. All ground together
    must cover a quarter of the scene, or else there is no ground. On top of a plane or an elevation grid,
    (``has_base``) a piece must also cover a quarter of the scene and 16 m^2, and be a mesh or at most 0.5 m high.
    """
    if not pieces or wanted == "none":
        return []
    if wanted != "auto":
        return _named(pieces, [pattern.strip() for pattern in wanted.split(",")])
    everything = np.concatenate([piece.vertices[:, :2] for piece in pieces])
    low, high = everything.min(0), everything.max(0)
    scene = float(np.prod(high - low))
    broad = [piece for piece in pieces if is_flat(piece)]
    if has_base:
        broad = [piece for piece in broad if piece.faces is not None or np.ptp(piece.vertices[:, 2]) <= HIGHEST_SLAB]
    candidates = [surface for surface in map(Surface.of, broad) if surface.covers]
    if not candidates or scene <= 0:
        return []
    cell = float((high - low).max()) / COMPARED
    columns, rows = (int(n) + 1 for n in np.ceil((high - low) / cell))
    origin = (float(low[0]) + cell / 2, float(low[1]) + cell / 2)
    points = _points(origin, cell, (rows, columns))
    heights = [surface.heights(*points) for surface in candidates]
    lowest = np.fmin.reduce(heights)
    least = max(LEAST_AREA, LEAST_COVER * scene) if has_base else 0.0
    chosen, covered = [], np.zeros((rows, columns), dtype=bool)
    for surface, height in zip(candidates, heights, strict=True):
        own = np.isfinite(height)
        lies_lowest = own.any() and own.sum() * cell**2 >= least and (height <= lowest + STEP)[own].mean() >= 0.5
        if lies_lowest and not _hangs(surface, height, pieces, origin, cell):
            chosen.append(surface)
            covered |= own
    return chosen if covered.sum() * cell**2 >= LEAST_COVER * scene else []


def _named(pieces: list[Piece], patterns: list[str]) -> list[Surface]:
    def matches(name: str) -> bool:
        return any(fnmatchcase(part, pattern) for pattern in patterns for part in (name, *name.split("/")))

    surfaces = [Surface.of(piece) for piece in pieces if matches(piece.name)]
    surfaces = [surface for surface in surfaces if len(surface.faces)]
    if not surfaces:
        names = sorted({piece.name for piece in pieces})[:20]
        raise ValueError(f"ground={','.join(patterns)!r} matches no piece with an upward surface; there are {names}")
    return surfaces


def _hangs(surface: Surface, height: np.ndarray, pieces: list[Piece], origin: tuple[float, float], cell: float) -> bool:
    others = [piece.vertices for piece in pieces if piece is not surface.piece]
    if not others:
        return False
    tops = np.array([(*(points.min(0) + points.max(0))[:2] / 2, points[:, 2].max()) for points in others])
    column, row = np.rint((tops[:, :2] - origin) / cell).astype(int).T
    here = height[np.clip(row, 0, height.shape[0] - 1), np.clip(column, 0, height.shape[1] - 1)]
    over = np.isfinite(here)
    return bool(over.any() and (tops[over, 2] <= here[over] + STEP).mean() > 0.5)


def is_flat(piece: Piece) -> bool:
    x, y, z = np.ptp(piece.vertices, axis=0)
    return bool(min(x, y) > 0 and z <= THICKEST * min(x, y))


def is_floor(terrain: Terrain, piece: Piece) -> bool:
    """Returns whether a piece lies on ground, and is as flat as a wheel climbs: tiles, roads and carpets."""
    size = np.ptp(piece.vertices[:, :2], axis=0)
    is_broad = size.min() >= NARROWEST_FLOOR and size.prod() >= SMALLEST_FLOOR
    return bool(is_broad) and STEP < height_over(terrain, piece) <= HIGHEST_FLOOR + 1e-6


def is_low(terrain: Terrain, piece: Piece) -> bool:
    """Returns whether an obstacle could be ground: a slab or a ramp."""
    return is_flat(piece) and STEP < height_over(terrain, piece) <= HIGHEST_SLAB


def height_over(terrain: Terrain, piece: Piece) -> float:
    """Returns how high a piece reaches over ground at most, m."""
    points = torch.from_numpy(np.concatenate((piece.vertices, piece.vertices.mean(0, keepdims=True))))
    return float((points[:, 2] - terrain.height_at(points[:, :2])).max())


@dataclass(frozen=True)
class Ground:
    """Everything that is ground: infinite planes, elevation grids, and upward surfaces of meshes."""

    planes: list[Plane]
    grids: list[Grid]
    surfaces: list[Surface]

    def heights(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Returns the heights at some points, the highest of all ground, m, or NaN."""
        layers = [_grid_heights(grid, x, y) for grid in self.grids]
        layers += [surface.heights(x, y) for surface in self.surfaces]
        for plane in self.planes:
            slope = plane.normal[:2] / plane.normal[2]
            layers.append(plane.point[2] - slope[0] * (x - plane.point[0]) - slope[1] * (y - plane.point[1]))
        return np.fmax.reduce(layers)

    def corners(self, around: np.ndarray) -> np.ndarray:
        """Returns points around the ground with an end, and around points ``[P, 2]`` on a plane: ``[Q, 2]``, m."""
        points = [surface.vertices[:, :2][np.unique(surface.faces)] for surface in self.surfaces]
        if self.planes and len(around):
            points += [around - 3.0, around + 3.0]
        return np.concatenate([np.empty((0, 2)), *points, *map(_grid_corners, self.grids)])


def make_terrain(ground: Ground, around: np.ndarray, cell: float | None) -> tuple[Terrain, list[str]]:
    """Returns the terrain, and notes about its accuracy.

    A plane is laid out around the points ``around [P, 2]`` (m) of obstacles and areas. Without a ``cell`` (m), the
    spacing is automatic.
    """
    levels = [float(plane.point[2]) for plane in ground.planes if plane.normal[2] > 1 - 1e-9]
    if len(levels) == len(ground.planes) and not ground.surfaces:
        if not ground.grids:
            return _flat(max(levels), around), []
        exact = _as_it_is(ground.grids, levels, cell)
        if exact is not None:
            return exact, []
    points = ground.corners(around)
    low, high = points.min(0), points.max(0)
    least = _least_cell(low, high)
    if cell is not None:
        cells = [cell]
    elif ground.grids:
        cells = [max(min(min(grid.cell) for grid in ground.grids), least)]
    else:
        own = _own_spacing(ground)
        cells = [spacing for spacing in ((own,) if own else ()) + CELLS if spacing >= least] or [least]
    # The coarsest spacing with a good error, or else the finest.
    for spacing in cells:
        terrain, notes, error = _sampled(ground, low, high, spacing)
        if error <= GOOD:
            break
    return terrain, notes


def _flat(level: float, around: np.ndarray) -> Terrain:
    points = around if len(around) else np.zeros((1, 2))
    low, high = np.floor(points.min(0) - SURROUNDINGS), points.max(0) + SURROUNDINGS
    cell = max(FLAT_CELL, _least_cell(low, high))
    columns, rows = (int(n) + 1 for n in np.ceil((high - low) / cell))
    return Terrain(torch.full((rows, columns), level), cell, (float(low[0]), float(low[1])))


def _as_it_is(grids: list[Grid], levels: list[float], cell: float | None) -> Terrain | None:
    """Returns the terrain of one grid alone, whose spacing may stay."""
    heights, (dx, dy), origin, yaw = grids[0]
    square = abs(dx - dy) <= 1e-9 * max(dx, dy) * max(heights.shape)
    stays = cell is None or math.isclose(cell, dx, rel_tol=1e-6)
    if len(grids) > 1 or abs(yaw) > 1e-6 or not square or not stays or heights.size > MAX_VALUES:
        return None
    heights = _filled(heights)
    return None if levels and max(levels) > heights.min() else Terrain(torch.from_numpy(heights), dx, origin)


def _own_spacing(ground: Ground) -> float | None:
    """Returns the spacing of a mesh whose vertices are a square grid, m."""
    if len(ground.surfaces) != 1 or ground.planes:
        return None
    (surface,) = ground.surfaces
    used = surface.vertices[np.unique(surface.faces), :2]
    spacings = []
    for axis in used.T:
        values = np.unique(axis.round(6))
        steps = np.diff(values)
        if len(values) < 3 or len(values) ** 2 > 16 * len(used) or np.ptp(steps) > 1e-3 * steps.mean():
            return None
        spacings.append(float(values[-1] - values[0]) / (len(values) - 1))
    return spacings[0] if math.isclose(*spacings, rel_tol=1e-4) else None


def _least_cell(low: np.ndarray, high: np.ndarray) -> float:
    return math.sqrt(float(np.prod(high - low)) / MAX_VALUES) * 1.01


def _sampled(ground: Ground, low: np.ndarray, high: np.ndarray, cell: float) -> tuple[Terrain, list[str], float]:
    """Returns the terrain with a spacing, its notes, and its error at 99 % of the middles of the cells (m)."""
    columns, rows = (max(2, math.floor(side / cell + 1e-6) + 1) for side in high - low)
    if rows * columns > MAX_VALUES:
        raise ValueError(
            f"the ground would have {rows} x {columns} heights at a cell of {cell:g} m; use a cell of at least "
            f"{_least_cell(low, high):.2g} m"
        )
    origin = (float(low[0]), float(low[1]))
    heights = ground.heights(*_points(origin, cell, (rows, columns)))
    terrain = Terrain(torch.from_numpy(_filled(heights)), cell, origin)
    middles = _points((origin[0] + cell / 2, origin[1] + cell / 2), cell, (rows - 1, columns - 1))
    truth = ground.heights(*middles)
    errors = np.abs(terrain.height_at(torch.from_numpy(np.stack(middles, -1))).numpy() - truth)
    errors = errors[np.isfinite(truth)] if np.isfinite(truth).any() else np.zeros(1)
    error, most = float(np.quantile(errors, 0.99)), 100 * errors.max()
    notes = [f"ground: cell {cell:g} m, error {100 * error:.1f} cm for 99 % of the surface, {most:.1f} cm at most"]
    holes = 1 - float(np.isfinite(heights).mean())
    if holes > 0.01:
        notes.append(f"ground: {100 * holes:.0f} % of the grid has no ground and takes the height of the nearest")
    return terrain, notes, error


def _points(origin: tuple[float, float], cell: float, shape: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Returns x and y of the points of a grid, ``[rows, columns]``, m."""
    x, y = (low + cell * np.arange(count) for low, count in zip(origin, shape[::-1], strict=True))
    return np.meshgrid(x, y)


def _filled(heights: np.ndarray) -> np.ndarray:
    empty = np.isnan(heights)
    if empty.all():
        raise ValueError("the ground has no surface at any point of its grid; use a smaller cell")
    if not empty.any():
        return heights
    return heights[tuple(distance_transform_edt(empty, return_distances=False, return_indices=True))]


def _grid_heights(grid: Grid, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    cos, sin = math.cos(grid.yaw), math.sin(grid.yaw)
    dx, dy = x - grid.origin[0], y - grid.origin[1]
    u, v = (cos * dx + sin * dy) / grid.cell[0], (cos * dy - sin * dx) / grid.cell[1]
    rows, columns = grid.heights.shape
    # Points on the border may be off it by rounding.
    u = np.where((u > -1e-6) & (u < columns - 1 + 1e-6), np.clip(u, 0, columns - 1), -1.0)
    v = np.where((v > -1e-6) & (v < rows - 1 + 1e-6), np.clip(v, 0, rows - 1), -1.0)
    return map_coordinates(grid.heights, [v, u], order=1, mode="constant", cval=np.nan)


def _grid_corners(grid: Grid) -> np.ndarray:
    rows, columns = grid.heights.shape
    u, v = grid.cell[0] * (columns - 1), grid.cell[1] * (rows - 1)
    cos, sin = math.cos(grid.yaw), math.sin(grid.yaw)
    corners = np.array([(0.0, 0.0), (u, 0.0), (0.0, v), (u, v)])
    return corners @ np.array([[cos, sin], [-sin, cos]]) + grid.origin
