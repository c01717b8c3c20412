"""Shortest paths of a rover's center through the free space of a world: costs, ways and lengths.

Paths run through the passable cells of :func:`rover_rl.sims.free_space.free_space`, through narrow ones only in
orientations in which the rover fits. Whether it can turn between two steps there is not tested, so that a path with a
sharp bend within a narrow passage may not be drivable.
"""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Callable, Sequence
from functools import lru_cache
from itertools import groupby
from typing import Any

import numpy as np
import torch
from torch import Tensor

from rover_rl.native.warp import launch_rows, wp
from rover_rl.robots import Robot
from rover_rl.sims.free_space.cells import LONGEST, ORIENTATIONS, STEPS, CellGrid, distance_to_cells, free_steps
from rover_rl.sims.free_space.ground import slopes_on_grid
from rover_rl.sims.free_space.path_kernels import BUCKETS, see, spread_costs
from rover_rl.sims.free_space.space import free_space
from rover_rl.worlds.region import overlap
from rover_rl.worlds.table import SlotTable
from rover_rl.worlds.terrain import MAX_SLOPE
from rover_rl.worlds.world import World, Worlds

CAUTION_DISTANCE = 0.35
"""Distance from the edge of the roomy cells within which caution increases the path cost, m."""
CAUTION_SLOPE = math.radians(12)
"""Slope of the ground above which caution increases the path cost, rad. On steeper ground, gravity takes so much of the
friction that a rover slides sideways and hardly turns."""
SPAN = LONGEST * math.sqrt(2)
"""Distance within which all cells of a step lie, in cells."""
MAX_CAUTION = 15.0
"""Largest caution. The queue of the kernel holds no longer steps."""
GOAL_RADIUS = 0.5
"""Distance at which the contract's task counts a goal as reached, m."""
SQUARE = 0.5
"""Side length of the squares whose goals share a field, m."""
KEPT_BYTES = 2**29
"""Memory of the fields that are kept, the last used ones."""
BYTES = 5
"""Memory of a cell of a field: a distance, and whether the cell is narrow."""
KEPT_GRIDS = 256
"""Number of worlds whose grids are kept, the last used ones."""
_OFFSET = 1 << 15
"""Makes the numbers of squares positive: worlds reach at most 16 km from their origins."""


class PathGrid:
    """Costs of the shortest paths to goals, from every cell of the free-space grid.

    Paths consist of steps in 32 directions, and end at the passable cell nearest to the goal. A cell without a path has
    the cost of the nearest cell with one. With ``caution``, at most 15, a path costs so much more in narrow cells, at
    the edge of the roomy cells, and on the steepest ground. It decreases linearly to 0 at a distance of 0.35 m from the
    edge, and on ground of 12 degrees. With 0, the cost is the length.

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
        # A margin around the grid counts as an edge.
        closed = np.pad(~space.roomy.numpy(), 1, constant_values=True)
        edge = distance_to_cells(closed, max(CAUTION_DISTANCE / space.cell, SPAN) + 1)[0][1:-1, 1:-1]
        extra = np.maximum(1 - edge * space.cell / CAUTION_DISTANCE, _steepness(world) if caution else 0.0).clip(0, 1)
        weights = np.where(space.passable.numpy(), 1 + caution * extra, 0).astype(np.float32)
        # All cells that a step leads to, within SPAN, are as free.
        is_open = (edge > SPAN) & (distance_to_cells(weights != 1, SPAN + 1)[0] > SPAN)
        self._offsets = np.array([y * self._shape[1] + x for x, y in STEPS])
        arrays = [(weights, float), (free_steps(space.orientations().numpy()), wp.uint32), (is_open, bool)]
        arrays += [(self._offsets, int), (np.array([math.hypot(*step) for step in STEPS]), float)]
        grid = [wp.array(np.ravel(values), dtype=kind, device="cpu") for values, kind in arrays]
        self._grid = [*(part.reshape((1, -1)) for part in grid[:4]), grid[4]]
        reachable = np.isfinite(self.spread(self._number(space.goal_cells[:1]))[0]).reshape(self._shape)
        self.reachable = torch.from_numpy(reachable)
        self._nearest = distance_to_cells(reachable)[1].ravel()

    def costs(self, goals: Tensor) -> Tensor:
        """Costs from every cell to goals ``[G, 2]`` (m): float32 ``[G, rows, columns]``, m, on the CPU."""
        costs = self.spread(self._nearest[self._number(goals)])[0]
        costs = costs.take(self._nearest, axis=1) * np.float32(self.cell)
        return torch.from_numpy(costs).reshape(len(goals), *self._shape)

    def path(self, start: Tensor, goal: Tensor) -> Tensor:
        """Points of the shortest path between two points ``[2]`` (m), for pictures: ``[P, 2]``, m."""
        first, last = self._nearest[self._number(torch.stack((start, goal)))]
        row, column = np.divmod(self.way(self.spread(np.array([last]))[1][0], first, last), self._shape[1])
        cells = torch.from_numpy(np.stack((column, row), -1) * self.cell + self.origin)
        return torch.cat((start[None], cells.to(start), goal[None]))

    def spread(self, sources: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Costs from every cell to the cells with numbers ``sources [G]``, in cells, and the last step of the way.

        ``[G, cells]`` each. Steps lead from the source to the cell.
        """
        return spread(self._grid, np.zeros(len(sources)), sources)

    def way(self, arrivals: np.ndarray, cell: int, source: int) -> np.ndarray:
        """Numbers of the cells from one with a path back to the source, by the ``arrivals [cells]`` of that."""
        cells = [int(cell)]
        while cells[-1] != source:
            cells.append(cells[-1] - int(self._offsets[arrivals[cells[-1]]]))
        return np.array(cells)

    def _number(self, points: Tensor) -> np.ndarray:
        """Numbers of the cells nearest to points ``[P, 2]`` (m): int64 ``[P]``."""
        # Of two cells that are equally near, the first one.
        index = np.ceil((points.double().cpu().numpy() - self.origin) / self.cell - 0.5).astype(np.int64)
        return np.ravel_multi_index(tuple(index.T[::-1]), self._shape, mode="clip")


def spread(grid: Sequence[Any], grids: np.ndarray, sources: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Costs from every cell to the cells with numbers ``sources [G]``, and the last step of the way, ``[G, cells]``.

    ``grid`` is what :func:`~rover_rl.sims.free_space.path_kernels.spread_costs` reads of one or several grids, of which
    each source has its number in ``grids [G]``.
    """
    shape = len(sources), grid[0].shape[1]
    costs = wp.full(shape, math.inf, dtype=float, device="cpu")
    heads = wp.full((len(sources), BUCKETS), -1, dtype=int, device="cpu")
    memory = [wp.empty(shape, dtype=int, device="cpu") for _ in range(3)]
    inputs = [*grid, *(numbers.astype(np.int32) for numbers in (grids, sources)), costs, heads, *memory]
    launch_rows(spread_costs, shape[:1], inputs, torch.device("cpu"), least=1)
    return costs.numpy(), memory[-1].numpy()


def _steepness(world: World) -> np.ndarray | float:
    """Slope of each cell: 0 up to ``CAUTION_SLOPE``, 1 from ``MAX_SLOPE`` on, ``[rows, columns]``."""
    if world.terrain.is_flat:
        return 0.0
    least, most = math.tan(CAUTION_SLOPE), math.tan(MAX_SLOPE)
    slopes = slopes_on_grid(world.terrain, CellGrid(overlap(world.bounds, world.terrain.extent)))
    return ((slopes - least) / (most - least)).clip(0, 1)


class PathDistances:
    """Distances to goals along the shortest free paths, for batches whose rows are in different worlds.

    The goals in a square of 0.5 m share a field of distances, those to the square's center. A field is computed on the
    CPU for the first goal in its square, and kept while there is memory.

    Args:
        worlds: worlds, by index. Usually ``RoverEnv.pool``.
        robot: robot that determines the free space, or a function that returns that of a world.
        device: device of positions and goals. ``None`` is the CPU.
        caution: relative extra cost of a path right beside an obstacle, as in :class:`PathGrid`.

    Example:
        >>> distances = PathDistances([get_world("maze")], get_robot("rover_zero"))
        >>> world, position = torch.zeros(2, 1, dtype=torch.int64), torch.zeros(2, 2)
        >>> distances(world, position, torch.tensor([[3.0, 0.0], [0.0, 3.0]])).shape
        torch.Size([2, 1])
    """

    def __init__(
        self,
        worlds: Worlds,
        robot: Robot | Callable[[World], Robot],
        device: torch.device | str | None = None,
        caution: float = 0.0,
    ) -> None:
        def grid(index: int) -> PathGrid:
            world = worlds[index]
            return PathGrid(world, robot(world) if callable(robot) else robot, caution)

        self._grid = lru_cache(KEPT_GRIDS)(grid)
        device = device or "cpu"
        # Distances of all cells, row by row; negative in cells without a path.
        self._fields = SlotTable((), torch.float32, device)
        # Whether cells are narrow.
        self._narrow = SlotTable((), torch.bool, device)
        # x and y of the first cell, side length of a cell, numbers of rows and columns.
        self._frames = SlotTable((), torch.float32, device)
        self._slots: OrderedDict[int, int] = OrderedDict()

    def __call__(self, world: Tensor, position: Tensor, goal: Tensor) -> Tensor:
        """Returns the distance from each position ``[..., 2]`` to its goal ``[..., 2]``, float32 ``[..., 1]``, m.

        ``world`` are the indices of the rows' worlds, int64 ``[..., 1]``.
        """
        fields = self.fields(world.flatten(), goal.reshape(-1, 2))
        return self.along(fields, position.reshape(-1, 2))[0].reshape(world.shape)

    def fields(self, world: Tensor, goal: Tensor) -> Tensor:
        """Number of the field of each goal ``[N, 2]`` (m) in a world, int64 ``[N]``, valid until the next call."""
        square = (goal / SQUARE).round().long() + _OFFSET
        keys, row = torch.unique((world << 32) | (square[:, 0] << 16) | square[:, 1], return_inverse=True)
        keys = keys.tolist()
        for key in keys:
            if key in self._slots:
                self._slots.move_to_end(key)
        missing = [key for key in keys if key not in self._slots]
        for index, group in groupby(missing, key=lambda key: key >> 32):
            self._compute(index, list(group), len(keys))
        return torch.tensor([self._slots[key] for key in keys], device=goal.device)[row]

    def along(self, fields: Tensor, position: Tensor) -> tuple[Tensor, Tensor]:
        """Distance (m) from positions ``[N, ..., 2]`` to the goals of ``fields [N]``, and whether there is a path."""
        slot, cell, inside = self._cells(fields, position)
        values = self._fields.values[slot, cell]
        return values.abs(), inside & ~values.signbit()

    def path(self, world: int, start: Tensor, goal: Tensor) -> Tensor:
        """Points of the shortest path between two points ``[2]`` of a world, ``[P, 2]``, m."""
        return self._grid(world).path(start, goal)

    def narrow(self, fields: Tensor, position: Tensor) -> Tensor:
        """Whether positions are in cells that the rover passes in some orientations only, as :meth:`along`."""
        slot, cell, inside = self._cells(fields, position)
        return inside & self._narrow.values[slot, cell]

    def _cells(self, fields: Tensor, position: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Number of the field and of the nearest cell, and whether positions are on the grid."""
        rows = [-1, *[1] * (position.ndim - 2)]
        x, y, cell, count_y, count_x = (part.reshape(rows) for part in self._frames.values[fields].unbind(-1))
        column, row = ((position[..., 0] - x) / cell).round(), ((position[..., 1] - y) / cell).round()
        inside = (column >= 0) & (row >= 0) & (column < count_x) & (row < count_y)
        column, row = (torch.minimum(n.clamp(min=0), most - 1) for n, most in ((column, count_x), (row, count_y)))
        return fields.reshape(rows), (row * count_x + column).long(), inside

    def _compute(self, index: int, keys: list[int], needed: int) -> None:
        """Computes the fields of squares in one world, of ``needed`` fields that the current call needs in all."""
        # A key consists of the index of the world, and the numbers of the square, in 32, 16 and 16 bits.
        grid = self._grid(index)
        squares = torch.tensor([((key >> 16) & 0xFFFF, key & 0xFFFF) for key in keys]) - _OFFSET
        costs = torch.where(grid.reachable, 1.0, -1.0) * grid.costs(squares * SQUARE)
        frame = torch.tensor((*grid.origin, grid.cell, *grid.passable.shape))
        for key, field in zip(keys, costs, strict=True):
            slot = self._free_slot(field.numel(), needed)
            self._slots[key] = slot
            self._fields[slot], self._frames[slot] = field.flatten(), frame
            self._narrow[slot] = (grid.passable & ~grid.roomy).flatten()

    def _free_slot(self, size: int, needed: int) -> int:
        """A new slot, or that of the field which has not been used for longest if the memory is used up."""
        most = max(needed, KEPT_BYTES // (BYTES * max(size, self._fields.values.shape[1])))
        return len(self._slots) if len(self._slots) < most else self._slots.popitem(last=False)[1]


def shortest_paths(world: World, robot: Robot, start: Tensor, goal: Tensor, goal_radius: float = GOAL_RADIUS) -> Tensor:
    """Length of the shortest path of the rover's center from each start to the disc around its goal.

    If the straight line is free, the length is exact. Otherwise, string pulling shortens the path of :class:`PathGrid`:
    the result is the shortest free polyline through points of that path. It exceeds the optimum by 0.6 % in the mean
    and 1.7 % at most (40 detours in the maze, compared with a grid in which each cell is split into 25).

    A path from a cell that is not passable starts with a straight line to the nearest passable cell.

    Args:
        world, robot: world of the paths, and robot that determines its free space.
        start: positions ``[count, 2]``, m, or poses ``[count, 3]``.
        goal: goals ``[count, 2]``, m.
        goal_radius: distance at which a goal is reached, m.

    Returns:
        Lengths, float32 ``[count]``, m: ``inf`` if there is no path, 0 if the start is within the disc.

    Example:
        >>> start, goal = torch.tensor([[-3.0, 0.0]]), torch.tensor([[-3.0, 3.0]])
        >>> shortest_paths(get_world("maze"), get_robot("rover_zero"), start, goal).shape
        torch.Size([1])
    """
    return _Strings(world, robot, goal_radius).lengths(start, goal)


class _Strings(PathGrid):
    """Paths of a world, pulled taut. Coordinates and lengths are in cells, centers whole numbers."""

    def __init__(self, world: World, robot: Robot, goal_radius: float) -> None:
        super().__init__(world, robot)
        self._reach = goal_radius / self.cell
        # Bits of the orientations in which the rover may be in each cell, and the passable cells.
        fits = np.pad(free_space(world, robot).orientations().numpy(), 1).astype(np.uint32)
        self._fits = wp.array(fits, dtype=wp.uint32, device="cpu")
        self._numbers = np.flatnonzero(self.passable.numpy())
        self._points = self._place(self._numbers)

    def _place(self, numbers: np.ndarray) -> np.ndarray:
        """X and y of cells."""
        row, column = np.divmod(numbers, self._fits.shape[1] - 2)
        return np.stack((column, row), -1).astype(float)

    def lengths(self, start: Tensor, goal: Tensor) -> Tensor:
        starts, goals = ((xy[:, :2].double().numpy() - np.array(self.origin)) / self.cell for xy in (start, goal))
        entries = self._entries(starts, goals)
        lengths = np.linalg.norm(entries - starts, axis=1)
        for index in np.flatnonzero(~self._visible(starts, entries) & (lengths > 0)):
            lengths[index] = self._detour_length(starts[index], goals[index])
        return torch.from_numpy(lengths * self.cell).float()

    def _entries(self, points: np.ndarray, goals: np.ndarray) -> np.ndarray:
        """Where the straight line from each point to its goal enters the goal's disc (inside: the point)."""
        away = points - goals
        distance = np.linalg.norm(away, axis=-1, keepdims=True)
        return goals + away * np.minimum(self._reach / np.maximum(distance, 1e-12), 1.0)

    def _visible(self, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """Whether the rover may drive straight from ``a [M, 2]`` to ``b [M, 2]``: bool ``[M]``."""
        span = b - a
        orientation = (
            np.rint(np.arctan2(span[:, 1], span[:, 0]) / math.pi * ORIENTATIONS).astype(np.int32) % ORIENTATIONS
        )
        free = wp.empty(len(a), dtype=bool, device="cpu")
        lines = [wp.array(points, dtype=wp.vec2d, device="cpu") for points in (a, b)]
        launch_rows(see, (len(a),), [self._fits, *lines, orientation, free], torch.device("cpu"))
        return free.numpy()

    def _detour_length(self, start: np.ndarray, goal: np.ndarray) -> float:
        """Length of the path from a start ``[2]`` to a goal ``[2]`` whose straight line is blocked."""
        first = self._numbers[((self._points - start) ** 2).sum(1).argmin()]
        (costs,), (arrivals,) = self.spread(np.array([first]))
        near = self._numbers[((self._points - goal) ** 2).sum(1) < (self._reach + 2) ** 2]
        ends = self._place(near)
        entries = self._entries(ends, goal)
        total = costs[near] + np.linalg.norm(entries - ends, axis=1)
        total[~self._visible(ends, entries)] = math.inf
        if not np.isfinite(total).any():
            return math.inf
        last = int(total.argmin())
        way = self._place(self.way(arrivals, near[last], first)[::-1])
        return self._pull(np.vstack((start, way, entries[last])), goal)

    def _pull(self, points: np.ndarray, goal: np.ndarray) -> float:
        """Length of the shortest free polyline through ``points [P, 2]`` from the first one to the disc."""
        count = len(points)
        ends = np.vstack((points, self._entries(points, goal)))
        i, j = np.indices((count, 2 * count)).reshape(2, -1)
        # Candidates lead to a later point of the path, or straight to the disc.
        wanted = ((j > i) & (j < count)) | (j == i + count)
        i, j = i[wanted], j[wanted]
        free = self._visible(points[i], ends[j]) | (j == i + 1)
        length = np.full((count, 2 * count), math.inf)
        length[i[free], j[free]] = np.linalg.norm(ends[j[free]] - points[i[free]], axis=1)
        best = np.full(count, math.inf)
        best[0] = 0.0
        for k in range(1, count):
            best[k] = (best[:k] + length[:k, k]).min()
        return float(min(best[-1], (best + np.diagonal(length, count)).min()))
