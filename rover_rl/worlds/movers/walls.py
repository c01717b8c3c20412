"""Distances to the walls of the worlds of a batch, for movers."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

from rover_rl.worlds.clearance import clearance_on_grid
from rover_rl.worlds.movers.motion import WallDistances
from rover_rl.worlds.table import SlotTable
from rover_rl.worlds.world import World

CELL = 0.1
"""Least spacing of the grid of distances, m."""
MAX_CELLS = 512
"""Maximum number of cells along a side of the grid."""
FAR = 3.0
"""Largest distance of interest, m."""


class WallTable:
    """Distances to the obstacles and the bounds of the worlds in slots."""

    def __init__(self, device: torch.device) -> None:
        self._distances = SlotTable((), torch.float32, device)
        self._grids = SlotTable((5,), torch.float32, device)

    def __setitem__(self, slot: int, world: World) -> None:
        distances, x, y, cell = _measured(world)
        self._distances[slot] = distances.reshape(-1)
        self._grids[slot] = torch.tensor([(x, y, cell, *distances.shape)])

    def of(self, slots: Tensor) -> WallDistances:
        """Returns the distances for rows in ``slots [N]``. Those of slots that were not set mean nothing."""
        used = len(self._grids.values)
        return WallDistances(self._distances.values, self._grids.values[:, :1].flatten(0, 1), slots.clamp(max=used - 1))


@lru_cache(maxsize=256)
def _measured(world: World) -> tuple[Tensor, float, float, float]:
    """Returns distances ``[rows, columns]`` on a grid over the bounds, and x and y of its first point and spacing."""
    (x_low, x_high), (y_low, y_high) = world.bounds
    cell = max(CELL, max(x_high - x_low, y_high - y_low) / MAX_CELLS)
    xs = np.arange(x_low, x_high + cell, cell)
    ys = np.arange(y_low, y_high + cell, cell)
    distances = clearance_on_grid(world.terrain, world.obstacles, xs, ys, FAR).numpy()
    edge_x, edge_y = np.minimum(xs - x_low, x_high - xs), np.minimum(ys - y_low, y_high - ys)
    edges = np.minimum(edge_x[None, :], edge_y[:, None])
    return torch.from_numpy(np.minimum(distances, edges)).float(), x_low, y_low, cell
