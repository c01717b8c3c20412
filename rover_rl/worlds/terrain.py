"""Terrain: ground heights on a regular grid, triangulated as a heightfield in Bullet."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import torch
from torch import Tensor

from rover_rl.worlds.region import Area

MAX_SLOPE = math.radians(25)
"""Largest slope of ground that rovers drive and start on, rad."""


@dataclass(frozen=True, eq=False)
class Terrain:
    """Ground heights on a regular grid.

    Each cell consists of two triangles, divided by the diagonal from ``(i + 1, j)`` to ``(i, j + 1)`` as in Bullet.
    Heights and normals are those of the triangles. (Bilinear interpolation would differ by centimeters.) Outside the
    grid, the height is that of the nearest point on the edge.

    Args:
        heights: heights ``[rows, columns]``, m, with row ``j`` at ``y = origin[1] + j * cell`` and column ``i`` at
            ``x = origin[0] + i * cell``. Any input of :func:`torch.as_tensor`, for example a NumPy array.
        cell: spacing of the grid, m.
        origin: ``(x, y)`` of ``heights[0, 0]``, m. ``None`` centers the grid at 0, 0.

    Raises:
        ValueError: if ``heights`` is not a finite 2D grid of at least 2 x 2, or ``cell`` is not positive.

    Example:
        >>> ramp = Terrain([[0.0, 1.0], [0.0, 1.0]], cell=10.0, origin=(0.0, 0.0))
        >>> ramp.height_at(torch.tensor([[5.0, 2.0]]))
        tensor([0.5000])
    """

    heights: Tensor
    cell: float
    origin: tuple[float, float] = None  # type: ignore[assignment]

    def __post_init__(self) -> None:
        heights = torch.as_tensor(self.heights, dtype=torch.float32).contiguous()
        if heights.ndim != 2 or min(heights.shape) < 2:
            raise ValueError(f"heights must be a grid of at least 2 x 2 values, got shape {tuple(heights.shape)}")
        if not torch.isfinite(heights).all():
            raise ValueError("heights must be finite numbers (meters), got NaN or infinity")
        if not self.cell > 0:
            raise ValueError(f"cell must be a positive length in meters, got {self.cell}")
        rows, columns = heights.shape
        origin = self.origin or (-(columns - 1) * self.cell / 2, -(rows - 1) * self.cell / 2)
        vars(self).update(heights=heights, origin=(float(origin[0]), float(origin[1])))

    @classmethod
    def flat(cls, size: tuple[float, float] = (20.0, 20.0), height: float = 0.0) -> Terrain:
        """Creates flat ground around the origin, with side lengths ``size`` along x and y, m.

        Raises:
            ValueError: if a side length is not a positive multiple of 0.1 m.
        """
        tenths = [round(10 * side) for side in size]
        if min(tenths) <= 0 or not all(math.isclose(10 * side, n) for side, n in zip(size, tenths, strict=True)):
            raise ValueError(f"the sides of flat ground must be positive multiples of 0.1 m, got {size}")
        # The largest square cell that tiles the ground, in tenths of a meter.
        square = math.gcd(*tenths)
        columns, rows = (n // square + 1 for n in tenths)
        return cls(torch.full((rows, columns), float(height)), cell=square / 10)

    @cached_property
    def is_flat(self) -> bool:
        """Whether all heights are equal, so that a simulator can use a plane."""
        return bool((self.heights == self.heights[0, 0]).all())

    @property
    def grid(self) -> Tensor:
        """X and y of the first height and spacing (m), and numbers of rows and columns, float64 ``[5]``."""
        return torch.tensor((*self.origin, self.cell, *self.heights.shape), dtype=torch.float64)

    @property
    def extent(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """Area of the grid, ``((x_low, x_high), (y_low, y_high))``, m."""
        x, y = self.origin
        rows, columns = self.heights.shape
        return (x, x + (columns - 1) * self.cell), (y, y + (rows - 1) * self.cell)

    def height_at(self, xy: Tensor) -> Tensor:
        """Returns the ground height (m) at points ``xy [..., 2]``: ``[...]``, with the dtype and device of ``xy``."""
        return self._plane_at(xy)[0]

    def normal_at(self, xy: Tensor) -> Tensor:
        """Returns the upward unit normal of the ground at points ``xy [..., 2]``: ``[..., 3]``."""
        _, rise_x, rise_y = self._plane_at(xy)
        normal = torch.stack((-(rise_x / self.cell), -(rise_y / self.cell), torch.ones_like(rise_x)), -1)
        return normal / normal.norm(dim=-1, keepdim=True)

    @cached_property
    def _copies(self) -> dict[tuple[torch.dtype, torch.device], Tensor]:
        return {}

    def _plane_at(self, xy: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        kind = (xy.dtype, xy.device)
        if kind not in self._copies:
            self._copies[kind] = self.heights.flatten().to(xy)
        return plane_at(xy, (*self.origin, self.cell, *self.heights.shape), self._copies[kind].__getitem__)

    def covering(self, area: Area) -> tuple[slice, slice]:
        """Returns the rows and columns of the part of the grid that covers an area (m), at least one cell."""
        columns, rows = (
            slice(
                min(max(int((low - start) // self.cell), 0), count - 2),
                max(min(int((high - start) // self.cell) + 2, count), 2),
            )
            for (low, high), start, count in zip(area, self.origin, reversed(self.heights.shape), strict=True)
        )
        return rows, columns

    def mesh(self, rows: slice = slice(None), columns: slice = slice(None)) -> tuple[Tensor, Tensor]:
        """Returns the triangle mesh of a part of the grid, by slices without a step.

        Returns:
            Vertices ``[V, 3]`` (m, float64), and triangles as vertex indices in counter-clockwise order from above,
            ``[F, 3]`` (int64).
        """
        heights = self.heights[rows, columns].double()
        xs, ys = (
            start + self.cell * torch.arange(count, dtype=torch.float64)[part]
            for start, count, part in zip(self.origin, self.heights.shape[::-1], (columns, rows), strict=True)
        )
        grid_y, grid_x = torch.meshgrid(ys, xs, indexing="ij")
        vertices = torch.stack((grid_x, grid_y, heights), -1).reshape(-1, 3)
        index = torch.arange(heights.numel()).reshape(heights.shape)
        a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:]
        triangles = (torch.stack(corners, -1).reshape(-1, 3) for corners in ((a, b, c), (b, d, c)))
        return vertices, torch.cat((*triangles,))


def plane_at(xy: Tensor, grid: Sequence[Any], height_of: Callable[[Tensor], Tensor]) -> tuple[Tensor, Tensor, Tensor]:
    """Interpolates heights on the two triangles of each cell, at points ``xy [..., 2]`` (m).

    ``grid`` is :attr:`Terrain.grid`, as numbers or tensors that fit ``[...]``, and ``height_of`` returns the heights
    with indices ``[...]``, counted row by row. Returns the height (m), and the rises of the triangle along x and along
    y over the length of the cell (m), ``[...]`` each.
    """
    x, y, cell, rows, columns = grid
    u = ((xy[..., 0] - x) / cell).clamp(min=0).clamp(max=columns - 1)
    v = ((xy[..., 1] - y) / cell).clamp(min=0).clamp(max=rows - 1)
    # The lower limit keeps the index of NaN, whose conversion is undefined, on the grid. Its height is NaN.
    i = u.long().clamp(min=0).clamp(max=columns - 2)
    j = v.long().clamp(min=0).clamp(max=rows - 2)
    u, v, corner = u - i, v - j, j * columns + i
    h00, h10, h01, h11 = map(height_of, (corner, corner + 1, corner + columns, corner + columns + 1))
    upper = u + v > 1
    rise_x = torch.where(upper, h11 - h01, h10 - h00)
    rise_y = torch.where(upper, h11 - h10, h01 - h00)
    height = torch.where(upper, h11 - (1 - u) * rise_x - (1 - v) * rise_y, h00 + u * rise_x + v * rise_y)
    return height, rise_x, rise_y


class TerrainRows(NamedTuple):
    """Terrain of each of ``N`` rows.

    Attributes:
        heights: heights of all slots, row by row, float32 ``[slots, capacity]``, m.
        slots: slot of each row, int64 ``[N]``.
        grids: :attr:`Terrain.grid` of each row, float64 ``[N, 5]``.
    """

    heights: Tensor
    slots: Tensor
    grids: Tensor

    def height_at(self, xy: Tensor) -> Tensor:
        """Returns the ground height (m) at points ``xy [N, ..., 2]``, float64, of each row's terrain: ``[N, ...]``."""
        rows = [-1, *[1] * (xy.ndim - 2)]
        x, y, cell, *counts = (part.reshape(rows) for part in self.grids.unbind(-1))
        slots = self.slots.reshape(rows)
        grid = (x, y, cell, *(count.long() for count in counts))
        return plane_at(xy, grid, lambda index: self.heights[slots, index].to(xy.dtype))[0]
