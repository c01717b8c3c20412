"""Costs of shortest paths to goals, from every cell of a world's free space."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from rover_rl.native.warp import wp
from rover_rl.robots import Robot
from rover_rl.sims.free_space.cell_grid import CellGrid, distance_to_cells
from rover_rl.sims.free_space.ground_limits import slopes_on_grid
from rover_rl.sims.free_space.path_kernels import BUCKETS, spread_costs
from rover_rl.sims.free_space.path_steps import LONGEST, STEPS, free_steps
from rover_rl.sims.free_space.space import FreeSpace, free_space
from rover_rl.worlds.region import overlap
from rover_rl.worlds.terrain import MAX_SLOPE
from rover_rl.worlds.world import World

CAUTION_DISTANCE = 0.35
"""Distance from the edge of the roomy cells within which caution increases the path cost, m."""
CAUTION_SLOPE = math.radians(12)
"""Slope of the ground above which caution increases the path cost, rad. On steeper ground, gravity takes so much of the
friction that a rover slides sideways and hardly turns."""
SPAN = LONGEST * math.sqrt(2)
"""Distance within which all cells of a step lie, in cells."""
MAX_CAUTION = 15.0
"""Largest caution. The queue of :func:`~rover_rl.sims.free_space.path_kernels.spread_costs` holds no longer steps."""


class PathGrid:
    """Costs of the shortest paths of the rover's center to goals, from every cell of the free-space grid.

    Paths are those of :func:`~rover_rl.sims.free_space.shortest_paths.shortest_paths` before string pulling, and end at
    the passable cell nearest to the goal. A cell without a path has the cost of the nearest cell with one. The search,
    a kernel, is three (maze) to seven times (moon) as fast as SciPy's: rewards need all costs to each new goal.

    Narrow cells are crossed only in orientations in which the rover fits. Whether it can turn between two steps there
    is not tested, so that a path with a sharp bend within a narrow passage may not be drivable.

    Args:
        world: world of the paths.
        robot: robot that determines the free space.
        caution: relative extra cost of a path in narrow cells, at the edge of the roomy cells, and on the steepest
            ground, at most 15. It decreases linearly to 0 at a distance of 0.35 m from the edge, and on ground of
            12 degrees. With 0, the cost is the length.

    Attributes:
        passable: cells through which paths may run, bool ``[rows, columns]``.
        roomy: those in which the rover can turn, bool ``[rows, columns]``.
        reachable: cells with a path to the goals, bool ``[rows, columns]``.
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
        self.passable, self.roomy = space.passable, space.roomy
        self.origin, self.cell = space.origin, space.cell
        self._shape = space.passable.shape
        self._prepare(space, caution, _steepness(world) if caution else 0.0)
        reachable = np.isfinite(self._spread(self._number(space.goal_cells[:1]))).reshape(self._shape)
        self.reachable = torch.from_numpy(reachable)
        self._nearest = distance_to_cells(reachable)[1].ravel()

    def _prepare(self, space: FreeSpace, caution: float, steepness: np.ndarray | float) -> None:
        """Copies weights, with ``caution`` also by the steepness, free steps and openness to the kernel's arrays."""
        # A margin around the grid counts as an edge.
        closed = np.pad(~space.roomy.numpy(), 1, constant_values=True)
        edge = distance_to_cells(closed, max(CAUTION_DISTANCE / space.cell, SPAN) + 1)[0][1:-1, 1:-1]
        extra = np.maximum(1 - edge * space.cell / CAUTION_DISTANCE, steepness).clip(0, 1)
        weights = np.where(space.passable.numpy(), 1 + caution * extra, 0).astype(np.float32)
        # A step leads to cells within SPAN.
        even = distance_to_cells(weights != 1, SPAN + 1)[0] > SPAN
        steps = free_steps(space.orientations().numpy())
        offsets, lengths = ([y * self._shape[1] + x for x, y in STEPS], [math.hypot(*step) for step in STEPS])
        arrays = ((weights, float), (steps, wp.uint32), ((edge > SPAN) & even, bool), (offsets, int), (lengths, float))
        self._grid = [wp.array(np.ravel(values), dtype=kind, device="cpu") for values, kind in arrays]

    def costs(self, goals: Tensor) -> Tensor:
        """Returns the costs from every cell to goals ``[G, 2]`` (m): float32 ``[G, rows, columns]``, m, on the CPU."""
        costs = self._spread(self._nearest[self._number(goals)]).take(self._nearest, axis=1) * np.float32(self.cell)
        return torch.from_numpy(costs).reshape(len(goals), *self._shape)

    def _spread(self, sources: np.ndarray) -> np.ndarray:
        """Returns the costs from every cell to the cells with numbers ``sources [G]``, in cells: ``[G, cells]``."""
        count, cells = len(sources), math.prod(self._shape)
        costs = wp.full((count, cells), math.inf, dtype=float, device="cpu")
        heads = wp.full((count, BUCKETS), -1, dtype=int, device="cpu")
        memory = [wp.empty((count, cells), dtype=int, device="cpu") for _ in range(3)]
        inputs = [*self._grid, sources.astype(np.int32), costs, heads, *memory]
        wp.launch(spread_costs, dim=count, inputs=inputs, device="cpu")
        return costs.numpy()

    def _number(self, points: Tensor) -> np.ndarray:
        """Returns the numbers of the cells nearest to points ``[P, 2]`` (m): int64 ``[P]``."""
        # Of two cells that are equally near, the first one.
        index = np.ceil((points.double().cpu().numpy() - self.origin) / self.cell - 0.5).astype(np.int64)
        return np.ravel_multi_index(tuple(index.T[::-1]), self._shape, mode="clip")


def _steepness(world: World) -> np.ndarray | float:
    """Returns the slope of each cell: 0 up to ``CAUTION_SLOPE``, 1 from ``MAX_SLOPE`` on, ``[rows, columns]``."""
    if world.terrain.is_flat:
        return 0.0
    least, most = math.tan(CAUTION_SLOPE), math.tan(MAX_SLOPE)
    slopes = slopes_on_grid(world.terrain, CellGrid(overlap(world.bounds, world.terrain.extent)))
    return ((slopes - least) / (most - least)).clip(0, 1)
