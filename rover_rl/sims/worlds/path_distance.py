"""Distance to a goal along the shortest free path, for a batch of rovers.

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
from rover_rl.sims.worlds.shortest_paths import distance_fields
from rover_rl.sims.worlds.world import World

ANCHOR_SPACING = 0.5
"""Distance between the anchors, the points that stand for the goals around them, m."""

Part = TypeVar("Part")


class PathDistance:
    """Distances in one world, looked up in a distance field for each anchor.

    Anchors are points of the goal area 0.5 m apart. The distance to a goal is the distance to its nearest anchor.

    Args:
        world: the world.
        robot: the robot that the path must be wide enough for.
        device: device of positions and goals; ``None``: the CPU.
        caution: how much a meter right beside an obstacle counts in addition: see
            :func:`~rover_rl.sims.worlds.shortest_paths.distance_fields`.
    """

    def __init__(
        self, world: World, robot: Robot, device: torch.device | str | None = None, caution: float = 0.0
    ) -> None:
        space = free_space(world, robot)
        blocks = torch.unique((space.goal_cells / ANCHOR_SPACING).round(), dim=0) * ANCHOR_SPACING
        anchors = space.goal_cells[torch.cdist(blocks, space.goal_cells).argmin(-1)].float()
        self._fields = distance_fields(world, robot, anchors, caution).to(device)
        self._anchors = anchors.to(device)
        self._origin = torch.tensor(space.origin, device=device)
        self._cell = space.cell

    def anchor(self, goal: Tensor) -> Tensor:
        """Index of the anchor nearest to each goal ``[N, 2]``: int64 ``[N]``."""
        return torch.cdist(goal, self._anchors).argmin(-1)

    def to_anchor(self, anchor: Tensor, position: Tensor) -> Tensor:
        """Distance to an anchor, by index, from positions ``[..., 2]``: float32 ``[...]``, m."""
        rows, columns = self._fields.shape[1:]
        column, row = ((position - self._origin) / self._cell).round().long().unbind(-1)
        return self._fields[anchor, row.clamp(0, rows - 1), column.clamp(0, columns - 1)]

    def __call__(self, position: Tensor, goal: Tensor) -> Tensor:
        """Distance from each position ``[N, 2]`` to its goal ``[N, 2]``: float32 ``[N, 1]``, m."""
        return self.to_anchor(self.anchor(goal), position)[:, None]


class PerWorld(Generic[Part]):
    """One object for each world of a batch, and a call that sends each row to the object of its world.

    Args:
        worlds: the world of each row.
        make: builds the object of a world.
        device: device of the rows' tensors; ``None``: the CPU.
    """

    def __init__(
        self, worlds: Sequence[World], make: Callable[[World], Part], device: torch.device | str | None = None
    ) -> None:
        distinct = dict.fromkeys(worlds)
        self._parts = [make(world) for world in distinct]
        rows = [torch.tensor([row for row, world in enumerate(worlds) if world is place]) for place in distinct]
        self._rows = [some.to(device) for some in rows]
        self._order = torch.cat(rows).argsort().to(device)

    def __call__(self, call: Callable[..., Tensor], *rows: Tensor) -> Tensor:
        """``call(part, *rows)`` with the rows of each world.

        Args:
            call: takes the world's object and tensors ``[M, k]``; returns ``[M, j]``.
            *rows: tensors ``[N, ..., k]`` of the batch; further dimensions are flattened for the call.

        Returns:
            The results in the batch's order, ``[N, ..., j]``.
        """
        results = []
        for part, index in zip(self._parts, self._rows, strict=True):
            some = [tensor[index] for tensor in rows]
            flat = [tensor.reshape(-1, tensor.shape[-1]) for tensor in some]
            results.append(call(part, *flat).unflatten(0, some[0].shape[:-1]))
        return torch.cat(results)[self._order]


class PathDistances:
    """Distances for a batch whose rows may be in different worlds: see :class:`PathDistance`.

    Args:
        worlds: the world of each row.
        robot: the robot that the path must be wide enough for.
        device: device of positions and goals; ``None``: the CPU.
        caution: as for :class:`PathDistance`.
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
        """Distance from positions ``[N, ..., 2]`` to goals ``[N, ..., 2]``: float32 ``[N, ..., 1]``, m."""
        return self._by_world(PathDistance.__call__, position, goal)
