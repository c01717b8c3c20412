"""Tells ground and obstacles apart."""

from __future__ import annotations

from dataclasses import dataclass
from fnmatch import fnmatchcase

import numpy as np
import torch

from rover_rl.worlds.files.contents import Piece
from rover_rl.worlds.files.triangles import face_normals, is_closed, signed_volume, surface_heights, upward_faces
from rover_rl.worlds.solids import hull
from rover_rl.worlds.terrain import Terrain

CELLS = 256
"""Number of cells along the longer side of the grid on which pieces are compared."""
THICKEST = 0.5
"""Largest height of a ground piece, in its shorter horizontal side."""
LEAST_SURFACE = 0.2
"""Least share of a ground piece's bounding rectangle that its surface covers, seen from above."""
LEAST_COVER = 0.25
"""Least share of the scene's bounding rectangle that ground covers, or else there is none."""
HIGHEST_SLAB = 0.5
"""Largest height of a simple shape, such as a box, that is ground on top of a plane or an elevation grid, m."""
LEAST_AREA = 16.0
"""Least area of a piece that is ground on top of a plane or an elevation grid, m^2."""
STEP = 0.01
"""Difference in height from which one piece is below another, m."""
HIGHEST_FLOOR = 0.05
"""Largest height of a floor, such as a carpet, over the ground that it lies on, m."""
NARROWEST_FLOOR = 0.5
"""Least width of a floor on other ground, m."""
SMALLEST_FLOOR = 1.0
"""Least area of a floor on other ground, m^2. The foot of a table is smaller."""


@dataclass(frozen=True)
class Surface:
    """The upward faces of a piece, that a wheel could stand on."""

    piece: Piece
    vertices: np.ndarray
    faces: np.ndarray

    @classmethod
    def of(cls, piece: Piece) -> Surface:
        """Returns the upward surface of a piece. Both sides of an open surface count."""
        vertices, faces = piece.vertices, piece.faces
        if faces is None:
            try:
                solid = hull(vertices)
                vertices, faces = solid.vertices.numpy(), solid.faces.numpy()
            except ValueError:
                faces = np.empty((0, 3), dtype=int)
        closed = is_closed(faces)
        if closed and signed_volume(vertices, faces) < 0:
            faces = faces[:, ::-1]
        return cls(piece, vertices, upward_faces(vertices, faces, both_sides=not closed))

    def heights(self, origin: tuple[float, float], cell: float, shape: tuple[int, int]) -> np.ndarray:
        """Returns the lowest upward surface at each point of a grid: ``[rows, columns]``, m, NaN beside it."""
        return surface_heights(self.vertices, self.faces, origin, cell, shape)

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
    cell = float((high - low).max()) / CELLS
    columns, rows = (int(n) + 1 for n in np.ceil((high - low) / cell))
    origin = (float(low[0]) + cell / 2, float(low[1]) + cell / 2)
    heights = [surface.heights(origin, cell, (rows, columns)) for surface in candidates]
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


def floors_on(terrain: Terrain, pieces: list[Piece]) -> list[Surface]:
    """Returns the pieces that lie on ground, and are as flat as a wheel climbs: tiles, roads and carpets."""
    return [
        Surface.of(piece)
        for piece in pieces
        if (size := np.ptp(piece.vertices[:, :2], axis=0)).min() >= NARROWEST_FLOOR
        and size.prod() >= SMALLEST_FLOOR
        and STEP < height_over(terrain, piece) <= HIGHEST_FLOOR + 1e-6
    ]


def height_over(terrain: Terrain, piece: Piece) -> float:
    """Returns how high a piece reaches over ground at most, m."""
    points = torch.from_numpy(np.concatenate((piece.vertices, piece.vertices.mean(0, keepdims=True))))
    return float((points[:, 2] - terrain.height_at(points[:, :2])).max())


def _named(pieces: list[Piece], patterns: list[str]) -> list[Surface]:
    """Returns the surfaces of pieces whose names, or a part of them between slashes, match a pattern."""
    named = [
        piece
        for piece in pieces
        if any(fnmatchcase(part, pattern) for pattern in patterns for part in (piece.name, *piece.name.split("/")))
    ]
    surfaces = [surface for surface in map(Surface.of, named) if len(surface.faces)]
    if not surfaces:
        names = sorted({piece.name for piece in pieces})
        raise ValueError(
            f"ground={','.join(patterns)!r} matches no piece with an upward surface; there are {names[:20]}"
        )
    return surfaces


def is_flat(piece: Piece) -> bool:
    """Returns whether a piece is broad."""
    x, y, z = np.ptp(piece.vertices, axis=0)
    return bool(min(x, y) > 0 and z <= THICKEST * min(x, y))


def _hangs(surface: Surface, height: np.ndarray, pieces: list[Piece], origin: tuple[float, float], cell: float) -> bool:
    """Returns whether most other pieces over or under a surface end below it, as walls do below a roof."""
    others = [piece.vertices for piece in pieces if piece is not surface.piece]
    if not others:
        return False
    tops = np.array([(*(points.min(0) + points.max(0))[:2] / 2, points[:, 2].max()) for points in others])
    column, row = np.rint((tops[:, :2] - origin) / cell).astype(int).T
    here = height[np.clip(row, 0, height.shape[0] - 1), np.clip(column, 0, height.shape[1] - 1)]
    over = np.isfinite(here)
    return bool(over.any() and (tops[over, 2] <= here[over] + STEP).mean() > 0.5)
