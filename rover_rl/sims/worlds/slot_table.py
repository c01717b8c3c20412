"""Data of the worlds in a :class:`~rover_rl.sims.worlds.table.WorldTable`, by slot, for lookups by row."""

from __future__ import annotations

import torch
from torch import Tensor

from rover_rl.sims.worlds.terrain import Terrain, interpolate_triangles

GROWTH = 1.25
"""Factor by which the longest possible list grows at least."""


class SlotTable:
    """A list of values for each slot, in one tensor. Values and lists of different sizes are padded.

    Args:
        shape: shape of a value. It grows with the values.
        dtype: type of the values.
        device: device of the table.
        padding: value of the padding.

    Attributes:
        values: values, ``[slots, capacity, *shape]``. All of these numbers grow as needed.
        lengths: number of values of each slot, int64 ``[slots]``.
    """

    def __init__(
        self, shape: tuple[int, ...], dtype: torch.dtype, device: torch.device | str, padding: float = 0
    ) -> None:
        self._padding = padding
        self.values = torch.zeros((0, 0, *shape), dtype=dtype, device=device)
        self.lengths = torch.zeros(0, dtype=torch.int64, device=device)

    def __setitem__(self, slot: int, values: Tensor) -> None:
        """Sets the list of a slot to ``values [length, *shape]``."""
        self._reserve(slot + 1, *values.shape)
        padded = self.values[slot].fill_(self._padding)
        padded[tuple(slice(size) for size in values.shape)] = values.to(self.values)
        self.lengths[slot] = len(values)

    def _reserve(self, slots: int, capacity: int, *shape: int) -> None:
        old_slots, old_capacity, *old = self.values.shape
        shape = tuple(map(max, shape, old))
        if slots <= old_slots and capacity <= old_capacity and [*shape] == old:
            return
        # Growing by a share keeps the number of copies low when slots are added one by one, and lists get longer.
        slots = old_slots if slots <= old_slots else max(slots, 2 * old_slots)
        capacity = old_capacity if capacity <= old_capacity else max(capacity, int(GROWTH * old_capacity))
        grown = self.values.new_full((slots, capacity, *shape), self._padding)
        grown[tuple(slice(size) for size in self.values.shape)] = self.values
        self.values = grown
        self.lengths = torch.cat((self.lengths, self.lengths.new_zeros(slots - old_slots)))


class TerrainTable:
    """Terrains of the worlds in slots. The height at a point is that of :meth:`Terrain.height_at`, to the last bit."""

    def __init__(self, device: torch.device | str) -> None:
        self._heights = SlotTable((), torch.float32, device)
        # x and y of the first height, spacing, numbers of rows and columns.
        self._grids = SlotTable((), torch.float64, device)

    def __setitem__(self, slot: int, terrain: Terrain) -> None:
        """Sets the terrain of a slot."""
        rows, columns = terrain.heights.shape
        self._heights[slot] = terrain.heights.reshape(-1)
        self._grids[slot] = torch.tensor((*terrain.origin, terrain.cell, rows, columns), dtype=torch.float64)

    def of(self, slots: Tensor) -> TerrainRows:
        """Returns the terrains of rows, by their slots ``[N]``."""
        return TerrainRows(self._heights.values, slots, self._grids.values[slots])


class TerrainRows:
    """Terrain of each of ``N`` rows, by the heights of all slots, the slots ``[N]`` and the grids ``[N, 5]`` of rows."""

    def __init__(self, heights: Tensor, slots: Tensor, grids: Tensor) -> None:
        self._heights, self._slots, self._grids = heights, slots, grids

    def height_at(self, xy: Tensor) -> Tensor:
        """Returns the ground height (m) at points ``xy [N, ..., 2]``, float64, of each row's terrain: ``[N, ...]``."""
        rows = [-1, *[1] * (xy.ndim - 2)]
        x, y, cell, count_y, count_x = (part.reshape(rows) for part in self._grids.unbind(-1))
        u = torch.minimum(((xy[..., 0] - x) / cell).clamp(min=0), count_x - 1)
        v = torch.minimum(((xy[..., 1] - y) / cell).clamp(min=0), count_y - 1)
        # The lower limit keeps the index of NaN, whose conversion is undefined, on the grid. Its height is NaN.
        i = torch.minimum(u.long().clamp(min=0), count_x.long() - 2)
        j = torch.minimum(v.long().clamp(min=0), count_y.long() - 2)
        columns = count_x.long()
        corner, slots = j * columns + i, self._slots.reshape(rows)
        corners = (corner, corner + 1, corner + columns, corner + columns + 1)
        return interpolate_triangles(u - i, v - j, *(self._heights[slots, k].to(xy.dtype) for k in corners))[0]
