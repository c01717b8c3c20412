"""Path distances of a batch of rovers to their goals on coarse cells, which training looks up in each step."""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Callable

import numpy as np
import torch
from scipy.ndimage import label
from torch import Tensor
from torch.nn.functional import pad

from rover_rl.native.warp import wp
from rover_rl.robots import Robot
from rover_rl.sims.free_space.cells import distance_to_cells
from rover_rl.sims.free_space.paths import spread
from rover_rl.sims.free_space.space import free_space
from rover_rl.worlds.table import SlotTable, in_threads
from rover_rl.worlds.world import World, Worlds

POOL = 2
"""Number of cells of the free space along a side of a coarse cell."""
NEIGHBORS = ((1, 0), (1, 1), (0, 1), (-1, 1), (-1, 0), (-1, -1), (0, -1), (1, -1))
SAME_GOAL = 0.25
"""Distance by which a goal may be told differently, as with noise, before it is another one, m."""
KEPT_BYTES = 2**29
"""Memory of the grids of worlds that are kept, the last used ones."""
BYTES = 13
"""Memory of a cell of a grid."""
CELLS_AT_ONCE = 2**23
"""Number of cells whose lengths are computed at once, which limits the memory to some 200 MB."""


class GoalFields:
    """Distances from anywhere to the goal of each row of a batch, along the shortest free paths.

    Paths lead from cell to cell, which are 0.2 m wide, in eight directions, so that a length is up to 8 % too long.
    Between the centers of cells, lengths are interpolated. A row's field of lengths is computed on the CPU, in some 0.4
    ms in a world of 20 m, when the row gets another goal. :class:`~rover_rl.sims.free_space.paths.PathDistances` takes
    ten times as long, is more exact, and pays where rows share goals.

    Args:
        worlds: worlds, by index. Usually ``RoverEnv.pool``.
        robot: robot that determines the free space, or a function that returns that of a world.

    Example:
        >>> fields = GoalFields([get_world("maze")], get_robot("rover_zero"))
        >>> fields.aim(torch.zeros(2, dtype=torch.int64), torch.tensor([[3.0, 0.0], [0.0, 3.0]]))
        >>> length, has_path = fields.along(torch.zeros(2, 2))
        >>> length.shape
        torch.Size([2])
    """

    def __init__(self, worlds: Worlds, robot: Robot | Callable[[World], Robot]) -> None:
        self._worlds, self._robot = worlds, robot
        self._slots: OrderedDict[int, int] = OrderedDict()
        self._grids = [SlotTable((), kind, "cpu") for kind in _KINDS]
        # By row: the world and the goal that the field leads to, the field, and the frame of its cells.
        self._world, self._goal, self._fields, self._frame = torch.zeros(4, 0).unbind()

    def aim(self, world: Tensor, goal: Tensor) -> None:
        """Computes the fields of rows whose world (its index, int64 ``[N]``) or goal (``[N, 2]``, m) is another one."""
        if len(world) != len(self._world):
            self._world, self._goal = torch.full_like(world, -1), torch.zeros_like(goal)
            self._fields, self._frame = goal.new_zeros(len(goal), 0), goal.new_ones(len(goal), 5)
        other = (world != self._world) | ((goal - self._goal).norm(dim=-1) > SAME_GOAL)
        rows = other.nonzero().squeeze(-1)
        if not len(rows):
            return
        self._world[rows], self._goal[rows] = world[rows], goal[rows]
        slots = self._enter(world[rows].tolist())
        cells = self._grids[0].values.shape[1]
        if cells > self._fields.shape[1]:
            self._fields = pad(self._fields, (0, cells - self._fields.shape[1]))
        size = max(1, CELLS_AT_ONCE // cells)
        for some, their_slots in zip(rows.split(size), slots.split(size), strict=True):
            fields, self._frame[some] = (part.to(goal) for part in self._compute(their_slots, goal[some].cpu()))
            self._fields[some, :cells] = fields

    def _compute(self, slots: Tensor, goal: Tensor) -> tuple[Tensor, Tensor]:
        """Lengths to goals in the worlds of slots, negative in cells without a path, and frames of the cells."""
        *grid, nearest, frames = (table.values for table in self._grids)
        nearest, frames = nearest[slots].long(), frames[slots]
        column, row = ((goal - frames[:, :2]) / frames[:, 2:3]).round().clamp(min=0).unbind(-1)
        row, column = torch.minimum(row, frames[:, 3] - 1), torch.minimum(column, frames[:, 4] - 1)
        sources = nearest.gather(1, (row * frames[:, 4] + column).long()[:, None]).squeeze(1)
        arrays = [wp.from_torch(*pair) for pair in zip(grid, _READ, strict=True)]
        costs = torch.from_numpy(spread([*arrays, _LENGTHS], slots.numpy(), sources.numpy())[0])
        has_path = nearest == torch.arange(nearest.shape[1])
        return torch.where(has_path, 1.0, -1.0) * costs.gather(1, nearest) * frames[:, 2:3], frames

    def along(self, position: Tensor) -> tuple[Tensor, Tensor]:
        """Distance (m) from positions ``[N, ..., 2]`` to the goal of their row, and whether paths lead through them."""
        x, y, cell, rows, columns = (part.reshape(-1, *[1] * (position.ndim - 2)) for part in self._frame.unbind(-1))
        column, row = (position[..., 0] - x) / cell, (position[..., 1] - y) / cell
        inside = (column > -0.5) & (row > -0.5) & (column < columns - 0.5) & (row < rows - 0.5)
        column, row = (torch.minimum(n.clamp(min=0), most - 1) for n, most in ((column, columns), (row, rows)))
        left, low = torch.minimum(column.floor(), columns - 2), torch.minimum(row.floor(), rows - 2)
        right, up = column - left, row - low
        first = (low * columns + left).long()
        above = first + columns.long()
        corners = torch.stack((first, first + 1, above, above + 1), -1)
        values = self._fields.gather(1, corners.flatten(1)).view_as(corners)
        shares = torch.stack(((1 - right) * (1 - up), right * (1 - up), (1 - right) * up, right * up), -1)
        has_path = ~values.signbit().gather(-1, shares.argmax(-1, keepdim=True)).squeeze(-1)
        return (values.abs() * shares).sum(-1), inside & has_path

    def _enter(self, worlds: list[int]) -> Tensor:
        """Returns the slots of worlds, whose grids are computed unless they are there: int64, on the CPU."""
        needed = [*dict.fromkeys(worlds)]
        for index in needed:
            if index in self._slots:
                self._slots.move_to_end(index)
        new = [index for index in needed if index not in self._slots]
        grids = in_threads(self._make, [self._worlds[index] for index in new])
        cells = max([self._grids[0].values.shape[1], *(len(grid[0]) for grid in grids)])
        most = max(KEPT_BYTES // (BYTES * cells), len(needed))
        entered = {}
        for index, grid in zip(new, grids, strict=True):
            full = len(self._slots) >= most
            slot = self._slots[index] = self._slots.popitem(last=False)[1] if full else len(self._slots)
            entered[slot] = [torch.from_numpy(values) for values in grid]
        for k, table in enumerate(self._grids):
            table.update({slot: values[k] for slot, values in entered.items()})
        return torch.tensor([self._slots[index] for index in worlds])

    def _make(self, world: World) -> list[np.ndarray]:
        """Coarse cells of a world, which are numbered row by row, by ``_KINDS``."""
        robot = self._robot(world) if callable(self._robot) else self._robot
        space = free_space(world, robot)
        passable = _pooled(space.passable.numpy())
        rows, columns = passable.shape
        around = np.pad(passable, 1)
        free = [passable & around[1 + y : 1 + y + rows, 1 + x : 1 + x + columns] for x, y in NEIGHBORS]
        steps = sum(bits.astype(np.int32) << k for k, bits in enumerate(free))
        corner = np.array(space.origin) + (POOL - 1) / 2 * space.cell
        cell = POOL * space.cell
        # All goals are connected, so that a path to one of them leads to all.
        column, row = ((space.goal_cells[0].numpy() - corner) / cell).round().astype(int)
        parts = label(passable, np.ones((3, 3)))[0]
        nearest = distance_to_cells(parts == parts[row, column])[1]
        offsets = np.array([y * columns + x for x, y in NEIGHBORS])
        found = passable, steps, np.zeros(passable.shape), offsets, nearest, np.array((*corner, cell, rows, columns))
        return [np.ravel(values) for values in found]


_KINDS = (torch.float32, torch.int32, torch.bool, torch.int32, torch.int32, torch.float32)
"""What is kept of the grid of a world: weights, steps, open cells (none) and offsets, as
:func:`~rover_rl.sims.free_space.path_kernels.spread_costs` reads them; the number of the nearest cell from which paths
lead to the goals; the frame: x and y of the first cell, side length of a cell, numbers of rows and columns."""
_READ = (wp.float32, wp.uint32, wp.bool, wp.int32)
_LENGTHS = np.array([math.hypot(*step) for step in NEIGHBORS], dtype=np.float32)


def _pooled(passable: np.ndarray) -> np.ndarray:
    """Which coarse cells have a passable cell, bool ``[rows, columns]``."""
    rows, columns = (max(2, -(-count // POOL)) for count in passable.shape)
    cells = np.zeros((rows * POOL, columns * POOL), dtype=bool)
    cells[: passable.shape[0], : passable.shape[1]] = passable
    return np.asarray(cells.reshape(rows, POOL, columns, POOL).any((1, 3)))
