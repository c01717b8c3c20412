"""Distances to goals along the shortest free paths, for batches whose rows are in different worlds.

Example:
    >>> distances = PathDistances([get_world("maze")], get_robot("rover_zero"))
    >>> distances(torch.zeros(2, 1, dtype=torch.int64), torch.zeros(2, 2), torch.tensor([[3.0, 0.0], [0.0, 3.0]])).shape
    torch.Size([2, 1])
"""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Callable
from functools import lru_cache
from itertools import groupby

import torch
from torch import Tensor

from rover_rl.robots import Robot
from rover_rl.worlds.table import SlotTable
from rover_rl.worlds.world import World, Worlds

SQUARE = 0.5
"""Side length of the squares whose goals share a field, m."""
STRIDE, DIRECTIONS = 0.15, 32
"""Length (m) of the steps of :meth:`PathDistances.path`, and number of directions that are compared in each."""
KEPT_BYTES = 2**29
"""Memory of the fields that are kept, the last used ones."""
BYTES = 5
"""Memory of a cell of a field: a distance, and whether the cell is narrow."""
KEPT_GRIDS = 256
"""Number of worlds whose grids are kept, the last used ones."""
_OFFSET = 1 << 15
"""Makes the numbers of squares positive: worlds reach at most 16 km from their origins."""


class PathDistances:
    """Distances to goals along the shortest free paths, for batches whose rows are in different worlds.

    The goals in a square of 0.5 m share a field of distances, those to the square's center. A field is computed on the
    CPU for the first goal in its square, and kept while there is memory.

    Args:
        worlds: worlds, by index. Usually ``RoverEnv.pool``.
        robot: robot that determines the free space, or a function that returns that of a world.
        device: device of positions and goals. ``None`` is the CPU.
        caution: relative extra cost of a path right beside an obstacle. See
            :class:`~rover_rl.sims.free_space.path_grid.PathGrid`.
    """

    def __init__(
        self,
        worlds: Worlds,
        robot: Robot | Callable[[World], Robot],
        device: torch.device | str | None = None,
        caution: float = 0.0,
    ) -> None:
        # Importing NVIDIA Warp takes half a second.
        from rover_rl.sims.free_space.path_grid import PathGrid

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
        """Returns the distance from each position to its goal.

        Args:
            world: index of each row's world, int64 ``[..., 1]``.
            position: positions, ``[..., 2]``, m.
            goal: goals, ``[..., 2]``, m.

        Returns:
            Distances, float32 ``[..., 1]``, m.
        """
        fields = self.fields(world.flatten(), goal.reshape(-1, 2))
        return self.along(fields, position.reshape(-1, 2))[0].reshape(world.shape)

    def fields(self, world: Tensor, goal: Tensor) -> Tensor:
        """Returns the number of each goal's field for :meth:`along`, valid until the next call: int64 ``[N]``.

        The arguments are the index of each row's world, int64 ``[N]``, and the goals, ``[N, 2]``, m.
        """
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
        """Returns the distance (m) from positions ``[N, ..., 2]`` to the goals of ``fields [N]``, and if there is one.

        They are float32 and bool ``[N, ...]``.
        """
        slot, cell, inside = self._cells(fields, position)
        values = self._fields.values[slot, cell]
        return values.abs(), inside & ~values.signbit()

    def path(self, world: int, start: Tensor, goal: Tensor) -> Tensor:
        """Returns points of the shortest path between two points ``[2]`` of a world, for pictures: ``[points, 2]``, m.

        It goes down the field of distances, and ends where there is no way on.
        """
        field = self.fields(torch.tensor([world], device=goal.device), goal[None])
        angles = torch.arange(DIRECTIONS, device=goal.device) * (2 * math.pi / DIRECTIONS)
        around = STRIDE * torch.stack((angles.cos(), angles.sin()), -1)
        points, left = [start], math.inf
        while torch.dist(points[-1], goal) > 2 * STRIDE:
            candidates = points[-1] + around
            distance, free = (values[0] for values in self.along(field, candidates[None]))
            # Cells are coarse: of those at the same distance, the one nearest to the goal.
            costs = torch.where(free, distance + 0.01 * (candidates - goal).norm(dim=-1), math.inf)
            best = int(costs.argmin())
            if not costs[best] < left:
                break
            points, left = [*points, candidates[best]], costs[best].item()
        return torch.stack([*points, goal])

    def narrow(self, fields: Tensor, position: Tensor) -> Tensor:
        """Returns whether positions are in cells that the rover passes in some orientations only, as :meth:`along`."""
        slot, cell, inside = self._cells(fields, position)
        return inside & self._narrow.values[slot, cell]

    def _cells(self, fields: Tensor, position: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Returns the number of the field and of the nearest cell, and whether positions are on the grid."""
        rows = [-1, *[1] * (position.ndim - 2)]
        x, y, cell, count_y, count_x = (part.reshape(rows) for part in self._frames.values[fields].unbind(-1))
        column, row = ((position[..., 0] - x) / cell).round(), ((position[..., 1] - y) / cell).round()
        inside = (column >= 0) & (row >= 0) & (column < count_x) & (row < count_y)
        column, row = (torch.minimum(n.clamp(min=0), most - 1) for n, most in ((column, count_x), (row, count_y)))
        return fields.reshape(rows), (row * count_x + column).long(), inside

    def _compute(self, index: int, keys: list[int], needed: int) -> None:
        """Computes the fields of squares in one world, of ``needed`` fields that the current call needs in all.

        A key consists of the index of the world, and the numbers of the square, in 32, 16 and 16 bits.
        """
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
        """Returns a new slot, or that of the field which has not been used for longest if the memory is used up."""
        most = max(needed, KEPT_BYTES // (BYTES * max(size, self._fields.values.shape[1])))
        return len(self._slots) if len(self._slots) < most else self._slots.popitem(last=False)[1]
