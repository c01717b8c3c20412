"""Square cells over an area of a world, steps between them in 32 directions, and orientations of a rover.

Orientation k of 32 is the yaw ``2 pi k / 64``, or its opposite.
"""

from __future__ import annotations

import math
from fractions import Fraction
from functools import reduce
from itertools import pairwise, product
from typing import Any

import numpy as np
import torch
from scipy.ndimage import distance_transform_edt
from torch import Tensor

from rover_rl.worlds.region import Area, Region

CELL = 0.1
"""Side length of a cell, m."""
LONGEST = 3
"""Greatest extent of a step along an axis, in cells."""
ORIENTATIONS = 32
ALL_ORIENTATIONS = 2**ORIENTATIONS - 1


class CellGrid:
    """Square cells that tile an area (m), with rows along y and at least two cells per axis for interpolation.

    Attributes:
        cell: side length of a cell, m.
        half_diagonal: largest distance of a point of a cell from its center, m.
        x, y: x of the centers of each column and y of those of each row, float64, m.
        origin: x, y of the center of the first cell, m.
        shape: numbers of rows and columns.
    """

    def __init__(self, area: Area) -> None:
        self.area, self.cell, self.half_diagonal = area, CELL, CELL / math.sqrt(2)
        counts = (max(2, math.floor((high - low) / CELL + 1e-6)) for low, high in area)
        self.x, self.y = (low + CELL * (np.arange(count) + 0.5) for count, (low, _) in zip(counts, area, strict=True))
        self.origin, self.shape = (float(self.x[0]), float(self.y[0])), (len(self.y), len(self.x))

    def centers(self, chosen: np.ndarray) -> Tensor:
        """Centers of the chosen cells, bool ``[rows, columns]``: float64 ``[count, 2]``, m."""
        # Three times as fast as numpy.nonzero.
        row, column = np.divmod(np.flatnonzero(chosen), len(self.x))
        return torch.from_numpy(np.stack((self.x[column], self.y[row]), -1))

    def within(self, area: Area, region: Region | None = None) -> np.ndarray:
        """Which cells lie entirely in an area, and by nine points in a region: bool ``[rows, columns]``."""
        half = self.cell / 2 - 1e-6
        in_x, in_y = (
            (axis - half >= low) & (axis + half <= high)
            for axis, (low, high) in zip((self.x, self.y), area, strict=True)
        )
        inside = in_y[:, None] & in_x
        if region is not None:
            for dx, dy in product((0, half, -half), repeat=2):
                x, y = torch.from_numpy(self.x + dx), torch.from_numpy(self.y + dy)
                inside &= region.contains(torch.stack(torch.meshgrid(x, y, indexing="xy"), -1)).numpy()
        return inside

    def distance_to_border(self) -> np.ndarray:
        """Distance of the centers from the border of the area: float64 ``[rows, columns]``, m."""
        (x_low, x_high), (y_low, y_high) = self.area
        in_x, in_y = np.minimum(self.x - x_low, x_high - self.x), np.minimum(self.y - y_low, y_high - self.y)
        return np.minimum(in_y[:, None], in_x)


def cells_of(grid: Any, points: Tensor) -> tuple[Tensor, Tensor]:
    """Rows and columns of the cells with the centers ``points [..., 2]`` (m): int64 ``[...]``."""
    column, row = ((points - torch.tensor(grid.origin)) / grid.cell).round().long().unbind(-1)
    return row, column


def distance_to_cells(marked: np.ndarray, limit: float = math.inf) -> tuple[np.ndarray, np.ndarray]:
    """Distance of each cell to the nearest ``marked`` one, at most ``limit``, in cells, and the number of that.

    Cells are numbered row by row. Without a marked cell, all have the limit and the number -1.
    """
    if not marked.any():
        return np.full(marked.shape, limit), np.full(marked.shape, -1, dtype=np.int32)
    distance, (rows, columns) = distance_transform_edt(~marked, return_indices=True)
    return np.minimum(distance, limit), rows * marked.shape[1] + columns


def ring(count: int, start: float = 0.0) -> Tensor:
    """Evenly spaced unit vectors, the first at the angle ``start`` (rad): float64 ``[count, 2]``."""
    angle = start + 2 * math.pi * torch.arange(count, dtype=torch.float64) / count
    return torch.stack((angle.cos(), angle.sin()), -1)


def _crossed_cells(step: tuple[int, int]) -> list[tuple[int, int]]:
    """Cells that a straight line from the center of cell (0, 0) to that of another runs through, without corners."""
    # Shares of the line at which it crosses the borders between cells, as exact fractions.
    borders = {Fraction(2 * k + 1, 2 * abs(side)) for side in step for k in range(abs(side))}
    shares = sorted({Fraction(0), Fraction(1), *borders})
    middles = [(a + b) / 2 for a, b in pairwise(shares)]
    return [(math.floor(t * step[0] + Fraction(1, 2)), math.floor(t * step[1] + Fraction(1, 2))) for t in middles]


_SIDES = range(-LONGEST, LONGEST + 1)
STEPS = sorted(
    ((x, y) for x in _SIDES for y in _SIDES if math.gcd(x, y) == 1), key=lambda step: math.atan2(*step[::-1])
)
"""Steps ``(x, y)`` to other cells in 32 directions, in cells, counter-clockwise."""
STEP_ORIENTATIONS = [round(math.atan2(y, x) / math.pi * ORIENTATIONS) % ORIENTATIONS for x, y in STEPS]
"""Orientation that is nearest to the direction of each step."""


def free_steps(fits: np.ndarray) -> np.ndarray:
    """Steps that are free from each cell: bit k of uint32 ``[rows, columns]`` is step k.

    The orientation of a step must fit in all cells that it runs through: ``fits`` are those of each cell, as bits.
    """
    rows, columns = fits.shape
    around = np.pad(fits.astype(np.uint32), LONGEST)
    steps = np.zeros_like(fits, dtype=np.uint32)
    for k, (step, orientation) in enumerate(zip(STEPS, STEP_ORIENTATIONS, strict=True)):
        crossed = [around[LONGEST + y :, LONGEST + x :][:rows, :columns] for x, y in _crossed_cells(step)]
        free = (reduce(np.bitwise_and, crossed) >> np.uint32(orientation)) & np.uint32(1)
        steps |= free << np.uint32(k)
    return steps
