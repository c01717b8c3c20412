"""Distances to the walls of the worlds of a batch, for movers."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

from rover_rl.worlds.clearance import clearance_on_grid
from rover_rl.worlds.movers.motions.base import WallGrids
from rover_rl.worlds.table import SlotTable, WorldTable
from rover_rl.worlds.world import World

CELL = 0.1
"""Least spacing of the grid of distances, m."""
MAX_CELLS = 512
"""Maximum number of cells along a side of the grid."""
FAR = 3.0
"""Largest distance of interest, m."""


class WallTable:
    """Distance to the obstacles and the bounds of the worlds in slots, an implementation of ``Walls``.

    Args:
        worlds: world of each row.
    """

    def __init__(self, worlds: WorldTable) -> None:
        self._worlds, device = worlds, worlds.slots.device
        self._distances = SlotTable((), torch.float32, device)
        # x and y of the first point, spacing, numbers of rows and columns.
        self._grids = SlotTable((5,), torch.float32, device)

    def __setitem__(self, slot: int, world: World) -> None:
        """Sets the world of a slot."""
        distances, x, y, cell = _measured(world)
        self._distances[slot] = distances.reshape(-1)
        self._grids[slot] = torch.tensor([(x, y, cell, *distances.shape)])

    def distance(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Returns distances and directions away from walls: see ``Walls.distance``."""
        used = len(self._grids.values)
        slots = self._worlds.slots.clamp(max=used - 1)
        x, y, cell, rows, columns = self._grids.values[slots, 0].T[..., None]
        u, v = (points[..., 0] - x) / cell, (points[..., 1] - y) / cell
        # The lower limit of the index keeps NaN, whose conversion is undefined, on the grid.
        i = torch.minimum(u.floor().clamp(min=0), columns - 2).long().clamp(min=0)
        j = torch.minimum(v.floor().clamp(min=0), rows - 2).long().clamp(min=0)
        corner, width = j * columns.long() + i, columns.long()
        corners = (corner, corner + 1, corner + width, corner + width + 1)
        d00, d10, d01, d11 = (self._distances.values[slots[:, None], k] for k in corners)
        s, t = (u - i).clamp(0, 1), (v - j).clamp(0, 1)
        low, high = d00 + s * (d10 - d00), d01 + s * (d11 - d01)
        # Beyond the grid, the distance falls with that from its edge.
        beyond = torch.maximum((u - i - s).abs(), (v - j - t).abs()) * cell
        rise = torch.stack(((1 - t) * (d10 - d00) + t * (d11 - d01), high - low), -1)
        length = rise.norm(dim=-1, keepdim=True)
        return low + t * (high - low) - beyond, torch.where(length > 1e-6, rise / length.clamp(min=1e-6), rise * 0)

    def grids(self) -> WallGrids:
        """Returns the grids of all slots: see ``Walls.grids``."""
        used = len(self._grids.values)
        return WallGrids(self._distances.values, self._grids.values[:, 0], self._worlds.slots.clamp(max=used - 1))


@lru_cache(maxsize=256)
def _measured(world: World) -> tuple[Tensor, float, float, float]:
    """Returns distances ``[rows, columns]`` on a grid over the bounds, and x and y of its first point and spacing."""
    (x_low, x_high), (y_low, y_high) = world.bounds
    cell = max(CELL, max(x_high - x_low, y_high - y_low) / MAX_CELLS)
    xs = np.arange(x_low, x_high + cell, cell)
    ys = np.arange(y_low, y_high + cell, cell)
    distances = clearance_on_grid(world, xs, ys, FAR).numpy()
    edge_x, edge_y = np.minimum(xs - x_low, x_high - xs), np.minimum(ys - y_low, y_high - ys)
    edges = np.minimum(edge_x[None, :], edge_y[:, None])
    return torch.from_numpy(np.minimum(distances, edges)).float(), x_low, y_low, cell
