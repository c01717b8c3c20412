"""Routes on maps of seen obstacles as plain tensor operations, for export: what ``route_kernels`` computes.

Costs are integers below 2^24, which floats hold exactly. Cells are addressed in a padded window, whose rows have
``SIZE`` cells and one more that is never free, so that the step to a neighbor is the same offset everywhere.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
import torch.nn.functional as F
from torch import Tensor
from torch._higher_order_ops.while_loop import while_loop

from rover_rl.envs.seen_map.cell_kernels import CELL, HALF, OPEN, SIZE
from rover_rl.envs.seen_map.route_kernels import (
    BESIDE,
    BESIDE_WEIGHT,
    DIAGONAL,
    LONGEST,
    NEAREST,
    OPEN_WEIGHT,
    ROOM,
    STRAIGHT,
    UNKNOWN_COST,
)

_WIDTH = SIZE + 1
"""Cells in a row of the padded window."""
_MARGIN = _WIDTH + 1
"""Cells before and after the rows of the padded window."""
_HOME = _MARGIN + HALF * _WIDTH + HALF
"""Address of the rover."""
_OFFSETS = (1, _WIDTH + 1, _WIDTH, _WIDTH - 1, -1, -_WIDTH - 1, -_WIDTH, -_WIDTH + 1)
"""Offsets of neighbors 0 to 7, counter-clockwise from +x."""
_UNKNOWN = float(UNKNOWN_COST)
_RELAXATIONS = 4
"""Relaxations of all cells from one check of the end to the next."""


def plan(levels: Tensor, center: Tensor, goal: Tensor, bounds: Tensor) -> tuple[Tensor, Tensor]:
    """Plans the route from the middle of each window to its goal.

    Args:
        levels: level of each cell, ``[N, SIZE, SIZE]``: see ``cell_kernels``.
        center: cells in the middle of the windows, ``[N, 2]``.
        goal: x and y of the goals, ``[N, 2]``, m.
        bounds: lower x and y and upper x and y of the area that routes stay in, ``[N, 4]``, m.

    Returns:
        x and y of the first two corners, ``[N, 2, 2]``, m, and the length of the route, ``[N]``, m: see
        ``plan_routes`` in ``route_kernels``.
    """
    # A goal outside of the window counts as at its edge.
    cell = ((goal / CELL).floor() - center + HALF).clamp(0, SIZE - 1)
    edges = ((bounds / CELL).clamp(-1e8, 1e8).floor() - center.repeat(1, 2) + HALF).clamp(-ROOM, SIZE - 1 + ROOM)
    weights = _padded(_weights(levels, cell, edges), 0.0)
    target = _MARGIN + cell[:, 1:].long() * _WIDTH + cell[:, :1].long()
    costs = _costs(weights, target)
    total = costs[:, _HOME]
    reachable = total < _UNKNOWN
    path, steps = _cheapest_path(costs, weights, torch.where(reachable[:, None], target, _HOME))
    cells, found = _corners(_padded(levels, 0.0), path, steps)
    corners = torch.where(found, (cells + (center - HALF)[:, None] + 0.5) * CELL, goal[:, None])
    return corners, torch.where(reachable, total * CELL / (OPEN_WEIGHT * STRAIGHT), -1.0)


def _padded(window: Tensor, value: float) -> Tensor:
    return F.pad(F.pad(window, (0, 1), value=value).flatten(1), (_MARGIN, _MARGIN), value=value)


def _weights(levels: Tensor, goal: Tensor, edges: Tensor) -> Tensor:
    """Returns the weights of the cells, ``[N, SIZE, SIZE]``; 0 where the rover cannot be.

    Args:
        levels: level of each cell, ``[N, SIZE, SIZE]``.
        goal: column and row of the goal, ``[N, 2]``.
        edges: column and row of the cells that hold the lower and the upper bounds, ``[N, 4]``.
    """
    number = torch.arange(SIZE, device=levels.device, dtype=levels.dtype)
    column, row = number[None, None, :], number[None, :, None]
    from_home = torch.maximum((column - HALF).abs(), (row - HALF).abs())
    from_goal = torch.maximum((column - goal[:, None, :1]).abs(), (row - goal[:, None, 1:]).abs())
    is_goal = from_goal == 0
    # The rover does not fit. But beside a wall, start and goal may seem to be so.
    beside = torch.where(torch.minimum(from_home, from_goal) > BESIDE, 0.0, float(BESIDE_WEIGHT))
    weight = torch.full_like(levels, float(OPEN_WEIGHT))
    for level, value in ((3, 3.0), (2, 6.0), (1, beside), (0, torch.where(is_goal, float(OPEN_WEIGHT), 0.0))):
        weight = torch.where(levels == level, value, weight)
    # The rover's center needs some room to the bounds.
    (lower_x, lower_y), (upper_x, upper_y) = ((part[:, :, None, None]).unbind(1) for part in edges.chunk(2, 1))
    inside = (column >= lower_x + ROOM) & (row >= lower_y + ROOM)
    inside = inside & (column <= upper_x - ROOM) & (row <= upper_y - ROOM)
    return torch.where(inside | is_goal, weight, 0.0)


def _costs(weights: Tensor, goal: Tensor) -> Tensor:
    """Returns the costs from the goal to all cells that may be on a cheapest path to the rover, exactly.

    All cells take the lowest cost over their neighbors until no cell changes that may still lower a cost on a cheapest
    path: one whose cost, with the least cost from there to the rover, does not exceed that of the rover.
    Costs of other cells may be too high.

    Args:
        weights: weights of the cells of the padded window, ``[N, L]``.
        goal: address of the goal, int64 ``[N, 1]``.
    """
    address = torch.arange(weights.shape[1], device=weights.device)
    # No path leads through the rover, or through cells that are not free.
    free = (weights > 0) & (address != _HOME)
    straight = torch.where(free, STRAIGHT * weights, _UNKNOWN)
    diagonal = torch.where(free, DIAGONAL * weights, _UNKNOWN)
    estimate = _least_costs(address)

    def going(costs: Tensor, active: Tensor) -> Tensor:
        return active.any()

    def relaxed(costs: Tensor, active: Tensor) -> tuple[Tensor, Tensor]:
        after = costs
        for _ in range(_RELAXATIONS):
            after = _relaxed(after, straight, diagonal)
        home = after[:, _HOME : _HOME + 1]
        return after, (after < costs) & (after + estimate <= home)

    costs = torch.where(address == goal, 0.0, torch.full_like(weights, _UNKNOWN))
    return _repeat(going, relaxed, (costs, address == goal))[0]


def _least_costs(address: Tensor) -> Tensor:
    """Returns the cost of the straight way from each cell of the padded window to the rover, if all is free."""
    from_first = address - _MARGIN
    x, y = from_first % _WIDTH - HALF, from_first.div(_WIDTH, rounding_mode="floor") - HALF
    most, least = torch.maximum(x.abs(), y.abs()), torch.minimum(x.abs(), y.abs())
    return (OPEN_WEIGHT * (STRAIGHT * (most - least) + DIAGONAL * least)).to(torch.float32)


def _relaxed(costs: Tensor, straight: Tensor, diagonal: Tensor) -> Tensor:
    """Returns the lowest cost of each cell over itself and the steps from its neighbors.

    Args:
        costs: costs of the cells of the padded window, ``[N, L]``.
        straight: cost of a straight step from each cell, ``[N, L]``.
        diagonal: cost of a diagonal step from each cell, ``[N, L]``.
    """
    count = costs.shape[1] - 2 * _MARGIN

    def at(values: Tensor, offset: int) -> Tensor:
        return values[:, _MARGIN + offset : _MARGIN + offset + count]

    aside, askew = costs + straight, costs + diagonal
    row, column = (torch.minimum(at(aside, offset), at(aside, -offset)) for offset in (1, _WIDTH))
    pairs = torch.minimum(askew[:, :-2], askew[:, 2:])
    corner = torch.minimum(pairs[:, : -2 * _WIDTH], pairs[:, 2 * _WIDTH :])
    lowest = torch.minimum(torch.minimum(row, column), torch.minimum(corner, at(costs, 0)))
    return F.pad(lowest, (_MARGIN, _MARGIN), value=_UNKNOWN)


def _cheapest_path(costs: Tensor, weights: Tensor, goal: Tensor) -> tuple[Tensor, Tensor]:
    """Returns the addresses of up to ``LONGEST`` steps of the cheapest path, ``[N, LONGEST + 1]``, and their number.

    Of equally cheap steps, the path takes that which goes on ahead, or the first.

    Args:
        costs: costs from the goal to the cells of the padded window, ``[N, L]``.
        weights: weights of the cells, ``[N, L]``.
        goal: address at which the path ends, int64 ``[N, 1]``.
    """
    offsets = torch.tensor(_OFFSETS, device=costs.device)
    direction = torch.arange(8, device=costs.device)
    lengths = torch.where(direction % 2 == 0, float(STRAIGHT), float(DIAGONAL))
    position = torch.arange(LONGEST + 1, device=costs.device)

    def going(number: Tensor, step: Tensor, path: Tensor) -> Tensor:
        return (number < LONGEST) & (path[:, -1:] != goal).any()

    def stepped(number: Tensor, step: Tensor, path: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        # The entries that are still to come hold the last cell.
        here = path[:, -1:]
        around = here + offsets
        weight, known = weights.gather(1, around), costs.gather(1, around)
        cost = torch.where((weight > 0) & (known < _UNKNOWN), known + lengths * weight, _UNKNOWN)
        rank = torch.where(direction == step, -1, direction)
        rank = torch.where(cost == cost.amin(1, keepdim=True), rank, 8).amin(1, keepdim=True)
        chosen = torch.where(rank < 0, step, rank)
        following = torch.where(here == goal, here, here + offsets[chosen])
        return number + 1, chosen, torch.where(position > number, following, path)

    start = torch.full_like(goal, _HOME)
    state = torch.zeros((), dtype=torch.int64, device=costs.device), torch.full_like(goal, -1)
    _, _, path = _repeat(going, stepped, (*state, start.repeat(1, LONGEST + 1)))
    return path, (path[:, :-1] != goal).sum(1, keepdim=True)


def _corners(levels: Tensor, path: Tensor, steps: Tensor) -> tuple[Tensor, Tensor]:
    """Finds up to two corners of each path by string pulling: see ``find_corners`` in ``route_kernels``.

    Args:
        levels: level of each cell of the padded window, ``[N, L]``.
        path: addresses of the cells of the path, int64 ``[N, LONGEST + 1]``.
        steps: number of steps of the path, int64 ``[N, 1]``.

    Returns:
        Column and row of the corners, float32 ``[N, 2, 2]``, and which were found, bool ``[N, 2, 1]``.
    """
    from_first = path - _MARGIN
    cells = torch.stack((from_first % _WIDTH, from_first.div(_WIDTH, rounding_mode="floor")), -1).to(levels.dtype)
    along = levels.gather(1, path)
    step = torch.arange(LONGEST, device=path.device)
    start, found = torch.zeros_like(steps), torch.ones_like(steps, dtype=torch.bool)
    corners = []
    for _ in range(2):
        # The corner is the cell before the first step to a cell that the straight line does not reach.
        first = cells.gather(1, start[..., None].expand(-1, -1, 2))
        due = (step >= start + NEAREST) & (step < steps) & found
        blocked = due & (_lowest_on_line(levels, first, cells[:, 1:]) < _lowest_on_path(along, start))
        number = torch.where(blocked, step, LONGEST).amin(1, keepdim=True)
        found = number < LONGEST
        start = torch.where(found, number, 0)
        corners.append((cells.gather(1, start[..., None].expand(-1, -1, 2)), found[..., None]))
    (one, has_one), (two, has_two) = corners
    return torch.cat((one, two), 1), torch.cat((has_one, has_two), 1)


def _lowest_on_path(levels: Tensor, start: Tensor) -> Tensor:
    """Returns the lowest of ``levels [N, LONGEST + 1]`` from the cell after ``start [N, 1]`` to each later one."""
    number = torch.arange(LONGEST + 1, device=levels.device)
    before = number[:, None] <= number[1:]
    counted = (number[:, None] > start[..., None]) & before
    return torch.where(counted, levels[..., None], float(OPEN)).amin(1)


def _lowest_on_line(levels: Tensor, start: Tensor, end: Tensor) -> Tensor:
    """Returns the lowest level of the cells between two cells, ``[N, E]``.

    Args:
        levels: level of each cell of the padded window, ``[N, L]``.
        start: column and row of the first cell, ``[N, 1, 2]``.
        end: column and row of the last cells, ``[N, E, 2]``.
    """
    offset = end - start
    count = offset.abs().amax(-1, keepdim=True)
    number = torch.arange(1, LONGEST, device=levels.device, dtype=levels.dtype)
    inside = number < count
    part = torch.where(inside, number / count, 0.0)
    column, row = (start[..., axis : axis + 1] + (part * offset[..., axis : axis + 1] + 0.5).floor() for axis in (0, 1))
    address = _MARGIN + (row * _WIDTH + column).long()
    values = levels.gather(1, address.flatten(1)).reshape(address.shape)
    return torch.where(inside, values, float(OPEN)).amin(-1)


def _repeat(
    condition: Callable[..., Tensor], body: Callable[..., tuple[Tensor, ...]], state: tuple[Tensor, ...]
) -> tuple[Tensor, ...]:
    """Applies ``body`` to the state while ``condition`` holds. An exported program holds the loop itself."""
    if torch.compiler.is_exporting():
        return while_loop(condition, body, state)
    while condition(*state):
        state = body(*state)
    return state
