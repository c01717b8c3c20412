"""Distance to a goal along the shortest free path, batched in torch.

Example:
    >>> distances = PathDistances([get_world("maze")] * 2, get_robot("rover_zero"))
    >>> distances(torch.zeros(2, 2), torch.tensor([[3.0, 0.0], [0.0, 3.0]])).shape
    torch.Size([2, 1])
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Generic, TypeVar

import torch
from torch import Tensor

from rover_rl.sims.robots import Robot
from rover_rl.sims.worlds.free_space import free_space
from rover_rl.sims.worlds.shortest_paths import DistanceFields
from rover_rl.sims.worlds.world import World

ANCHOR_SPACING = 0.5
"""Distance between the anchors, which represent the goals around them, m."""

Part = TypeVar("Part")


class PathDistance:
    """Path distances in one world, from distance fields.

    There is one field per anchor. Anchors are points of the goal area, 0.5 m apart. The distance to a goal is the
    distance to the nearest anchor. A field is computed when the first goal near its anchor is given, and kept. On a
    GPU, all fields are computed ahead, as a check for missing ones would wait for the device.

    Args:
        world: world of the paths.
        robot: robot that determines the free space.
        device: device of positions and goals. ``None`` is the CPU.
        caution: relative extra cost of a path right beside an obstacle. See
            :class:`~rover_rl.sims.worlds.shortest_paths.DistanceFields`.
    """

    def __init__(
        self, world: World, robot: Robot, device: torch.device | str | None = None, caution: float = 0.0
    ) -> None:
        space = free_space(world, robot)
        blocks = torch.unique((space.goal_cells / ANCHOR_SPACING).round(), dim=0) * ANCHOR_SPACING
        anchors = space.goal_cells[torch.cdist(blocks, space.goal_cells).argmin(-1)].float()
        self._distance_fields = DistanceFields(world, robot, caution)
        self._anchors = anchors.to(device)
        self._origin = torch.tensor(space.origin, device=device)
        self._cell = space.cell
        self._fields = torch.empty(len(anchors), *space.passable.shape, device=device)
        self._is_computed = torch.zeros(len(anchors), dtype=torch.bool)
        if self._anchors.is_cuda:
            self._compute(torch.arange(len(anchors)))

    def _compute(self, anchors: Tensor) -> None:
        """Computes the fields of the anchors with the given indices."""
        self._fields[anchors] = self._distance_fields(self._anchors[anchors].cpu()).to(self._fields.device)
        self._is_computed[anchors] = True

    def anchor(self, goal: Tensor) -> Tensor:
        """Returns the index of the anchor nearest to each goal ``[N, 2]``: int64 ``[N]``."""
        nearest = torch.cdist(goal, self._anchors).argmin(-1)
        if not self._anchors.is_cuda:
            missing = nearest[~self._is_computed[nearest]]
            if len(missing):
                self._compute(missing.unique())
        return nearest

    def to_anchor(self, anchor: Tensor, position: Tensor) -> Tensor:
        """Returns the distance from positions to anchors.

        Args:
            anchor: indices of the anchors, int64 ``[...]``.
            position: positions ``[..., 2]``, m.

        Returns:
            Distances, float32 ``[...]``, m.
        """
        rows, columns = self._fields.shape[1:]
        column, row = ((position - self._origin) / self._cell).round().long().unbind(-1)
        return self._fields[anchor, row.clamp(0, rows - 1), column.clamp(0, columns - 1)]

    def __call__(self, position: Tensor, goal: Tensor) -> Tensor:
        """Returns the distance from each position ``[N, 2]`` to its goal ``[N, 2]``: float32 ``[N, 1]``, m."""
        return self.to_anchor(self.anchor(goal), position)[:, None]


class PerWorld(Generic[Part]):
    """One object per distinct world of a batch. Calls process each row with the object of its world.

    Args:
        worlds: world of each row.
        make: function that creates the object of a world.
        device: device of the rows' tensors. ``None`` is the CPU.
    """

    def __init__(
        self, worlds: Sequence[World], make: Callable[[World], Part], device: torch.device | str | None = None
    ) -> None:
        distinct = dict.fromkeys(worlds)
        self._parts = [make(world) for world in distinct]
        rows = [torch.tensor([row for row, world in enumerate(worlds) if world is other]) for other in distinct]
        self._rows = [index.to(device) for index in rows]
        self._order = torch.cat(rows).argsort().to(device)

    def __call__(self, call: Callable[..., Tensor], *rows: Tensor) -> Tensor:
        """Calls ``call(part, *rows)`` for each world, with the rows of that world.

        Args:
            call: function that takes the world's object and tensors ``[M, k]``, and returns ``[M, j]``.
            *rows: tensors ``[N, ..., k]`` of the batch. The dimensions before the last are flattened for the call.

        Returns:
            Results in the order of the batch, ``[N, ..., j]``.
        """
        results = []
        for part, index in zip(self._parts, self._rows, strict=True):
            selected = [tensor[index] for tensor in rows]
            flat = [tensor.reshape(-1, tensor.shape[-1]) for tensor in selected]
            results.append(call(part, *flat).unflatten(0, selected[0].shape[:-1]))
        return torch.cat(results)[self._order]


class PathDistances:
    """Path distances of a batch whose rows may be in different worlds. See :class:`PathDistance`.

    Args:
        worlds: world of each row.
        robot: robot that determines the free space.
        device: device of positions and goals. ``None`` is the CPU.
        caution: relative extra cost of a path right beside an obstacle. See
            :class:`~rover_rl.sims.worlds.shortest_paths.DistanceFields`.
    """

    def __init__(
        self,
        worlds: Sequence[World],
        robot: Robot,
        device: torch.device | str | None = None,
        caution: float = 0.0,
    ) -> None:
        self._by_world = PerWorld(worlds, lambda world: PathDistance(world, robot, device, caution), device)

    def __call__(self, position: Tensor, goal: Tensor) -> Tensor:
        """Returns the distance from positions ``[N, ..., 2]`` to goals ``[N, ..., 2]``: float32 ``[N, ..., 1]``, m."""
        return self._by_world(PathDistance.__call__, position, goal)
