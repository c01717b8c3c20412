"""Grid of square cells over an area of a world."""

from __future__ import annotations

import math
from itertools import product

import numpy as np
import torch
from torch import Tensor

from rover_rl.sims.worlds.region import Area, Region

CELL = 0.1
"""Side length of a cell, m."""


class CellGrid:
    """Square cells that tile an area, with rows along y and at least two cells per axis for interpolation.

    Args:
        area: area, m.

    Attributes:
        cell: side length of a cell, m.
        half_diagonal: largest distance of a point of a cell from its center, m.
        x: x of the centers of each column, float64 ``[columns]``, m.
        y: y of the centers of each row, float64 ``[rows]``, m.
        origin: x, y of the center of the first cell, m.
    """

    def __init__(self, area: Area) -> None:
        self.cell = CELL
        self.half_diagonal = self.cell / math.sqrt(2)
        self.area = area
        self.x, self.y = (self._axis(*ends) for ends in area)
        self.origin = (float(self.x[0]), float(self.y[0]))

    def _axis(self, low: float, high: float) -> np.ndarray:
        count = max(2, math.floor((high - low) / self.cell + 1e-6))
        return low + self.cell * (np.arange(count) + 0.5)

    @property
    def shape(self) -> tuple[int, int]:
        """Number of rows and columns."""
        return len(self.y), len(self.x)

    def centers(self, chosen: np.ndarray) -> Tensor:
        """Returns the centers of the chosen cells, bool ``[rows, columns]``: float64 ``[count, 2]``, m."""
        # Three times as fast as numpy.nonzero.
        row, column = np.divmod(np.flatnonzero(chosen), len(self.x))
        return torch.from_numpy(np.stack((self.x[column], self.y[row]), -1))

    def indices(self, centers: Tensor) -> tuple[Tensor, Tensor]:
        """Returns the rows and columns of the cells with the given centers, ``[count, 2]`` (m): int64 ``[count]``."""
        column, row = ((centers - torch.tensor(self.origin)) / self.cell).round().long().unbind(-1)
        return row, column

    def marked(self, centers: Tensor) -> np.ndarray:
        """Returns which cells have the given centers, ``[count, 2]`` (m): bool ``[rows, columns]``."""
        marked = np.zeros(self.shape, dtype=bool)
        marked[self.indices(centers)] = True
        return marked

    def within(self, area: Area) -> np.ndarray:
        """Returns which cells lie entirely in ``area``: bool ``[rows, columns]``."""
        half = self.cell / 2 - 1e-6
        (x_low, x_high), (y_low, y_high) = area
        in_x = (self.x - half >= x_low) & (self.x + half <= x_high)
        in_y = (self.y - half >= y_low) & (self.y + half <= y_high)
        return in_y[:, None] & in_x

    def within_region(self, region: Region) -> np.ndarray:
        """Returns which cells lie in a region, by nine points of each: bool ``[rows, columns]``."""
        inside = np.ones(self.shape, dtype=bool)
        for dx, dy in product((0, 1, -1), repeat=2):
            x, y = (torch.from_numpy(axis + d * (self.cell / 2 - 1e-6)) for axis, d in ((self.x, dx), (self.y, dy)))
            inside &= region.contains(torch.stack(torch.meshgrid(x, y, indexing="xy"), -1)).numpy()
        return inside

    def distance_to_border(self) -> np.ndarray:
        """Returns the distance of the centers from the border of the area: float64 ``[rows, columns]``, m."""
        (x_low, x_high), (y_low, y_high) = self.area
        in_x, in_y = np.minimum(self.x - x_low, x_high - self.x), np.minimum(self.y - y_low, y_high - self.y)
        return np.minimum(in_y[:, None], in_x)


def ring(count: int, start: float = 0.0) -> Tensor:
    """Returns evenly spaced unit vectors, the first at the angle ``start`` (rad): float64 ``[count, 2]``."""
    angle = start + 2 * math.pi * torch.arange(count, dtype=torch.float64) / count
    return torch.stack((angle.cos(), angle.sin()), -1)
