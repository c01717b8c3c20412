"""Costs of shortest paths to goals, from every cell of a world's free space."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
import torch
from scipy.ndimage import distance_transform_edt, label
from torch import Tensor

from rover_rl.sims.native.warp import wp
from rover_rl.sims.robots import Robot
from rover_rl.sims.worlds.free_space import free_space
from rover_rl.sims.worlds.grid_kernels import BUCKETS, find_steps, spread_costs
from rover_rl.sims.worlds.path_steps import STEPS
from rover_rl.sims.worlds.world import World

CAUTION_DISTANCE = 0.35
"""Distance from the edge of the passable ground within which caution increases the path cost, m."""
MAX_CAUTION = 15.0
"""Largest caution. The queue of :func:`~rover_rl.sims.worlds.grid_kernels.spread_costs` holds no longer steps."""


class PathGrid:
    """Costs of the shortest paths of the rover's center to goals, from every cell of the free-space grid.

    Paths are those of :func:`~rover_rl.sims.worlds.shortest_paths.shortest_paths` before string pulling, and end at the
    passable cell nearest to the goal. A cell without a path has the cost of the nearest cell with one.

    Args:
        world: world of the paths.
        robot: robot that determines the free space.
        caution: relative extra cost of a path at the edge of the passable ground, at most 15. It decreases linearly to
            0 at a distance of 0.35 m from the edge. With 0, the cost is the length.

    Attributes:
        passable: whether the rover's center may be anywhere in a cell, bool ``[rows, columns]``.
        origin: x, y of the center of cell ``[0, 0]``, m.
        cell: side length of a cell, m.

    Raises:
        ValueError: if ``caution`` is negative or too large.

    Example:
        >>> grid = PathGrid(get_world("maze"), get_robot("rover_zero"))
        >>> grid.costs(torch.tensor([[-3.0, 0.0]])).shape
        torch.Size([1, 200, 200])
    """

    def __init__(self, world: World, robot: Robot, caution: float = 0.0) -> None:
        if not 0 <= caution <= MAX_CAUTION:
            raise ValueError(f"caution must be at least 0 and at most {MAX_CAUTION:g}, got {caution}")
        space = free_space(world, robot)
        self.passable, self.origin, self.cell = space.passable, space.origin, space.cell
        passable = space.passable.numpy()
        self._shape = passable.shape
        # The part with the goals. Diagonal steps between two obstacles that touch at a corner connect cells, too.
        parts, _ = label(passable, structure=np.ones((3, 3)))
        row, column = self._cells(space.goal_cells[:1])[0]
        self._nearest = distance_transform_edt(
            parts != parts[row, column], return_distances=False, return_indices=True
        ).reshape(2, -1)
        # A margin around the grid counts as not passable.
        clearance = distance_transform_edt(np.pad(passable, 1))[1:-1, 1:-1] * self.cell
        weights = np.where(passable, 1 + caution * (1 - clearance / CAUTION_DISTANCE).clip(0), 0).astype(np.float32)
        self._weights = wp.array(weights, dtype=float, device="cpu")
        self._steps = wp.zeros(self._shape, dtype=wp.uint32, device="cpu")
        crossed, starts, self._lengths = _step_table()
        wp.launch(find_steps, dim=self._shape, inputs=[self._weights, crossed, starts, self._steps], device="cpu")
        self._offsets = wp.array([y * self._shape[1] + x for x, y in STEPS], dtype=int, device="cpu")

    def costs(self, goals: Tensor) -> Tensor:
        """Returns the costs from every cell to goals ``[G, 2]`` (m): float32 ``[G, rows, columns]``, m, on the CPU."""
        count, cells = len(goals), self._weights.size
        rows, columns = self._nearest[:, np.ravel_multi_index(tuple(self._cells(goals).T), self._shape)]
        costs = wp.full((count, cells), math.inf, dtype=float, device="cpu")
        heads = wp.full((count, BUCKETS), -1, dtype=int, device="cpu")
        following, preceding = (wp.empty((count, cells), dtype=int, device="cpu") for _ in range(2))
        sources = wp.array(rows * self._shape[1] + columns, dtype=int, device="cpu")
        grid = [self._weights.flatten(), self._steps.flatten(), self._offsets, self._lengths]
        wp.launch(spread_costs, dim=count, inputs=[*grid, sources, costs, heads, following, preceding], device="cpu")
        found = costs.numpy().reshape(count, *self._shape)[:, self._nearest[0], self._nearest[1]]
        return torch.from_numpy(found * np.float32(self.cell)).reshape(count, *self._shape)

    def _cells(self, points: Tensor) -> np.ndarray:
        """Returns the row and column of the cells nearest to points ``[..., 2]``: int64 ``[..., 2]``."""
        index = (points.double().cpu().numpy() - self.origin) / self.cell
        # Of two cells that are equally near, the first one.
        return np.ceil(index - 0.5).astype(np.int64)[..., ::-1].clip(0, np.array(self._shape) - 1)


@lru_cache(maxsize=1)
def _step_table() -> tuple[wp.array, wp.array, wp.array]:
    """Cells that each step runs through, as flat lists with their starts, and lengths of the steps (cells)."""
    crossed = [cell for cells in STEPS.values() for cell in cells]
    starts = np.cumsum([0, *map(len, STEPS.values())])
    lengths = [math.hypot(*step) for step in STEPS]
    return (
        wp.array(crossed, dtype=wp.vec2i, device="cpu"),
        wp.array(starts, dtype=int, device="cpu"),
        wp.array(lengths, dtype=float, device="cpu"),
    )
