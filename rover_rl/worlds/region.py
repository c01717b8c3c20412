"""Areas of a world: rectangles, and regions of any shape."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import torch
from torch import Tensor

Range: TypeAlias = tuple[float, float]
Area: TypeAlias = tuple[Range, Range]

POLYGON_CELL = 0.05
"""Side length of the cells of a polygon, m."""
MAX_CELLS = 4_000_000
"""Largest number of cells of a polygon. A larger polygon has larger cells."""


@dataclass(frozen=True, eq=False)
class Region:
    """Part of a world's ground, as cells of a grid: the rooms of a building, for example.

    Args:
        mask: cells of the region, bool ``[rows, columns]``, with rows along y. Cells without a chosen one around them
            are cut off.
        cell: side length of a cell, m.
        origin: x, y of the lower left corner of ``mask[0, 0]``, m.

    Raises:
        ValueError: if the mask has another shape or no chosen cell, or a number is out of range.

    Example:
        >>> region = Region.polygon([(0, 0), (6, 0), (6, 2), (2, 2), (2, 6), (0, 6)])
        >>> region.contains(torch.tensor([[1.0, 5.0], [5.0, 5.0]])).tolist()
        [True, False]
    """

    mask: Tensor
    cell: float
    origin: tuple[float, float]

    def __post_init__(self) -> None:
        mask = torch.as_tensor(self.mask)
        if mask.dtype != torch.bool or mask.ndim != 2 or not mask.any():
            raise ValueError(f"the mask of a region must be bool [rows, columns] with a true cell, got {mask.dtype}")
        numbers = (self.cell, *self.origin)
        if not (all(map(math.isfinite, numbers)) and self.cell > 0):
            raise ValueError(f"a region must have a positive cell and a finite origin, got {numbers}")
        rows, columns = (mask.any(k).nonzero()[:, 0] for k in (1, 0))
        row, column = int(rows[0]), int(columns[0])
        mask = mask[row : int(rows[-1]) + 1, column : int(columns[-1]) + 1].clone()
        origin = (self.origin[0] + column * self.cell, self.origin[1] + row * self.cell)
        vars(self).update(mask=mask, cell=float(self.cell), origin=origin)

    @classmethod
    def polygon(cls, corners: Sequence[Sequence[float]]) -> Region:
        """Returns the region within a polygon of at least three corners ``(x, y)`` in order (m), in cells of 5 cm.

        Raises:
            ValueError: if these are no corners of a polygon, or it has no area.
        """
        try:
            points = torch.tensor(corners, dtype=torch.float64)
        except (TypeError, ValueError):
            points = torch.empty(0)
        if points.ndim != 2 or points.shape[1:] != (2,) or len(points) < 3 or not points.isfinite().all():
            raise ValueError(f"a polygon must have at least three corners (x, y) of finite numbers, got {corners}")
        low, high = points.aminmax(dim=0)
        width, depth = (high - low).tolist()
        cell = max(POLYGON_CELL, math.sqrt(width * depth / MAX_CELLS))
        x, y = (
            start + cell * (torch.arange(max(1, math.ceil(side / cell - 1e-6)), dtype=torch.float64) + 0.5)
            for start, side in zip(low.tolist(), (width, depth), strict=True)
        )
        inside = torch.zeros(len(y), len(x), dtype=torch.bool)
        for (ax, ay), (bx, by) in zip(points, points.roll(-1, 0), strict=True):
            # A cell is inside if a ray from its center to the left crosses an odd number of sides.
            crossed = (y < ay) != (y < by)
            at = ax + (y[crossed] - ay) * (bx - ax) / (by - ay)
            inside[crossed] ^= at[:, None] < x
        if not inside.any():
            raise ValueError(f"the polygon {corners} has no area")
        return cls(inside, cell, (float(low[0]), float(low[1])))

    @property
    def bounds(self) -> Area:
        """Bounding rectangle, ``((x_low, x_high), (y_low, y_high))``, m."""
        (x, y), (rows, columns) = self.origin, self.mask.shape
        return (x, x + columns * self.cell), (y, y + rows * self.cell)

    @property
    def area(self) -> float:
        """Size, m^2."""
        return int(self.mask.sum()) * self.cell**2

    def contains(self, xy: Tensor) -> Tensor:
        """Returns whether points ``xy [..., 2]`` (m) are in the region: bool ``[...]``."""
        mask = self.mask.to(xy.device)
        index = ((xy - torch.tensor(self.origin, dtype=xy.dtype, device=xy.device)) / self.cell).floor()
        within = ((index >= 0) & (index < torch.tensor(mask.shape[::-1], device=xy.device))).all(-1)
        column, row = torch.where(within[..., None], index, 0.0).long().unbind(-1)
        return within & mask[row, column]


def overlap(a: Area, b: Area) -> Area:
    """Returns the intersection of two rectangles, which is empty (low >= high) if they are disjoint."""
    x, y = ((max(p[0], q[0]), min(p[1], q[1])) for p, q in zip(a, b, strict=True))
    return x, y


def union(a: Area, b: Area) -> Area:
    """Returns the smallest rectangle around two rectangles."""
    x, y = ((min(p[0], q[0]), max(p[1], q[1])) for p, q in zip(a, b, strict=True))
    return x, y


def expanded(area: Area, margin: float) -> Area:
    """Returns a rectangle that reaches ``margin`` (m) farther on every side, or less far if it is negative."""
    (x_low, x_high), (y_low, y_high) = area
    return (x_low - margin, x_high + margin), (y_low - margin, y_high + margin)
