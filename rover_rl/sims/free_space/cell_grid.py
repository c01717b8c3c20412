"""Grid of square cells over an area of a world, and distances between cells."""

from __future__ import annotations

import math
from itertools import product
from typing import Any

import numpy as np
import torch
from scipy.ndimage import distance_transform_edt
from torch import Tensor

from rover_rl.worlds.region import Area, Region

CELL = 0.1
"""Side length of a cell, m."""


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
        self.cell = CELL
        self.half_diagonal = self.cell / math.sqrt(2)
        self.area = area
        self.x, self.y = (self._axis(*ends) for ends in area)
        self.origin = (float(self.x[0]), float(self.y[0]))
        self.shape = (len(self.y), len(self.x))

    def _axis(self, low: float, high: float) -> np.ndarray:
        count = max(2, math.floor((high - low) / self.cell + 1e-6))
        return low + self.cell * (np.arange(count) + 0.5)

    def centers(self, chosen: np.ndarray) -> Tensor:
        """Returns the centers of the chosen cells, bool ``[rows, columns]``: float64 ``[count, 2]``, m."""
        # Three times as fast as numpy.nonzero.
        row, column = np.divmod(np.flatnonzero(chosen), len(self.x))
        return torch.from_numpy(np.stack((self.x[column], self.y[row]), -1))

    def within(self, area: Area, region: Region | None = None) -> np.ndarray:
        """Returns which cells lie entirely in an area, and by nine points in a region: bool ``[rows, columns]``."""
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
        """Returns the distance of the centers from the border of the area: float64 ``[rows, columns]``, m."""
        (x_low, x_high), (y_low, y_high) = self.area
        in_x, in_y = np.minimum(self.x - x_low, x_high - self.x), np.minimum(self.y - y_low, y_high - self.y)
        return np.minimum(in_y[:, None], in_x)


def cells_of(grid: Any, points: Tensor) -> tuple[Tensor, Tensor]:
    """Returns the rows and columns of the cells with the centers ``points [..., 2]`` (m): int64 ``[...]``."""
    column, row = ((points - torch.tensor(grid.origin)) / grid.cell).round().long().unbind(-1)
    return row, column


def distance_to_cells(marked: np.ndarray, limit: float = math.inf) -> tuple[np.ndarray, np.ndarray]:
    """Returns the distance of each cell to the nearest ``marked`` one, at most ``limit``, in cells, and its number.

    Cells are numbered row by row. Without a marked cell, all have the limit and the number -1.
    """
    if not marked.any():
        return np.full(marked.shape, limit), np.full(marked.shape, -1, dtype=np.int32)
    distance, (rows, columns) = distance_transform_edt(~marked, return_indices=True)
    return np.minimum(distance, limit), rows * marked.shape[1] + columns


def ring(count: int, start: float = 0.0) -> Tensor:
    """Returns evenly spaced unit vectors, the first at the angle ``start`` (rad): float64 ``[count, 2]``."""
    angle = start + 2 * math.pi * torch.arange(count, dtype=torch.float64) / count
    return torch.stack((angle.cos(), angle.sin()), -1)
