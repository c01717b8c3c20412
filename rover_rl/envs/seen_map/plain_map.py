"""``PlainSeenMap``: :class:`~rover_rl.envs.seen_map.seen_map.SeenMap` of one rover as tensor operations, for export.

What a scan tells is computed by the same :class:`~rover_rl.envs.seen_map.scans.ScanReader`. All cells are updated at
once, and the costs of routes by sweeps over all cells until none of them changes: the rules and constants are those of
the kernels, without their lists, queues and threads.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import product

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch._higher_order_ops.while_loop import while_loop

from rover_rl.envs.config import LidarConfig, RobotLike
from rover_rl.envs.seen_map import route_kernels as routes
from rover_rl.envs.seen_map.scans import (
    CELL,
    CLOSED,
    DOUBTFUL,
    HALF,
    HIT,
    MAX_TILT,
    MOST,
    NO_GAP,
    OCCUPIED,
    OPEN,
    PARTS,
    REACH,
    SIZE,
    STATE,
    STRETCH,
    SUSPECTED,
    UNSEEN,
    Scan,
    ScanReader,
    goal_positions,
    in_units,
    limits_of,
    map_unit,
    relative_route,
    route_in_meters,
)
from rover_rl.envs.sensors.scan_pose import pose_of_scan

_WINDOW = (SIZE, SIZE)
_DIGITS = (1.0, 16.0, 256.0, 4096.0, 65536.0)
"""Place values of what a number in the state tells of a cell: its evidence, and the four sides of its box.

The sides are ``PARTS - 1 - first`` and ``last`` along x, and along y, as for the kernels."""
_STEPS = ((1, 0), (1, 1), (0, 1), (-1, 1), (-1, 0), (-1, -1), (0, -1), (1, -1))
"""Columns and rows from a cell to its neighbors, in the order of the kernels."""
_HALFWAY = (STRETCH + 1) // 2
"""Largest distance from a cell to those that it is halfway between, in columns and rows."""
_SWEEPS = 4
"""Sweeps over all cells from one check of the end to the next."""


class PlainSeenMap(nn.Module):
    """One decision of a :class:`~rover_rl.envs.seen_map.seen_map.SeenMap` of one rover as a function of tensors."""

    state_size = sum(STATE) + 2 * SIZE * SIZE
    """Number of entries of the state."""

    def __init__(
        self, lidar: LidarConfig | None = None, robot: RobotLike = "rover_zero", interval: float = 0.2
    ) -> None:
        super().__init__()
        self._reader, self._limits = ScanReader(lidar or LidarConfig(), robot, interval), limits_of(robot)
        self._unit = map_unit(robot)

    def forward(
        self,
        state: Tensor,
        lidar: Tensor,
        pose: Tensor,
        imu: Tensor,
        target: Tensor,
        bounds: Tensor,
        scan_pose: Tensor | None = None,
        lidar_mask: Tensor | None = None,
    ) -> tuple[Tensor, Tensor]:
        """Adds a scan and plans the route.

        Args:
            state: state before, ``[1, state_size]``: that of the rover (see ``scans.STATE``), and then what has been
                seen in each cell of the window and how high it is. Zeros at the start of an episode.
            lidar: lidar readings, ``[1, P]``, m.
            pose: x, y and z, ``[1, 3]``, m.
            imu: pitch, roll and yaw, ``[1, 3]``, rad.
            target: distance (m) and relative angle (rad) of the goal, ``[1, 2]``.
            bounds: lower x and y and upper x and y of the area that the routes stay in, ``[1, 4]``, m.
            scan_pose: where the scan was taken, ``[1, 6]``. ``None``: where the rover is.
            lidar_mask: which readings beams cover, ``[1, P]``. ``None``: all in the robot's view.

        Returns:
            The route, ``[1, 5]``, as ``SeenMap`` returns it, and the next state.
        """
        taken = None
        if scan_pose is not None:
            position, attitude = pose_of_scan(pose, imu, scan_pose)
            taken = position / self._unit, attitude
        lidar, pose, target = in_units(self._unit, lidar, pose, target)
        bounds = bounds / self._unit
        before = state[:, : sum(STATE)]
        scan, rover = self._reader(before, lidar, pose, imu, taken=taken, mask=lidar_mask)
        codes, heights = _moved(state[0, sum(STATE) :].reshape(2, *_WINDOW), scan.center[0] - before[0, :2])
        codes = torch.where(scan.cleared, 0.0, codes)
        ground = scan.ground[0]
        tops = _in_cells(scan, ground[:, :2], ground[:, 2] > UNSEEN, ground[None, :, 2], UNSEEN, "amax")[0]
        heights = torch.maximum(torch.where(scan.cleared, UNSEEN, heights), tops)
        codes = _with_scan(codes, _walls(heights), scan)
        goal, center = goal_positions(pose, imu, target), scan.center
        corners, length = _plan(
            self._levels(codes, scan.rough),
            ((goal / CELL).floor() - center + HALF).clamp(0, SIZE - 1).long()[0],
            (bounds / CELL).clamp(-1e8, 1e8).floor()[0] - center[0].repeat(2) + HALF,
        )
        corners = torch.where(corners < 0, goal, (corners + center - HALF + 0.5) * CELL)[None]
        state = torch.cat((rover, corners[:, 0], torch.stack((codes, heights)).flatten()[None]), -1)
        return route_in_meters(self._unit, relative_route(corners, length[None], pose, imu)), state

    def levels(self, state: Tensor) -> Tensor:
        """Returns the level of each cell in a state, ``[SIZE, SIZE]``: see ``SeenMap.levels``."""
        codes = state[0, sum(STATE) : sum(STATE) + SIZE * SIZE].reshape(_WINDOW)
        return self._levels(codes, state[0, STATE[0]] > 0)

    def _levels(self, codes: Tensor, rough: Tensor) -> Tensor:
        evidence, sides = _unpacked(codes)
        reach = self._limits.reach
        width = 2 * reach + 1
        # The surroundings of a cell at an edge of the window reach over to the opposite edge.
        around = F.unfold(F.pad(sides[None], (reach,) * 4, mode="circular"), width).reshape(4, width, width, -1)
        offset = torch.arange(-reach, reach + 1, device=codes.device)
        # Distances from the boxes in cells that are `offset` cells away to the middle of the cell, in parts.
        middle = PARTS // 2 - PARTS * offset
        x = torch.maximum(PARTS - 1 - around[0] - middle[:, None], middle[:, None] - around[1] - 1)
        y = torch.maximum(PARTS - 1 - around[2] - middle[:, None, None], middle[:, None, None] - around[3] - 1)
        square = torch.where(around[0] < 0, math.inf, x.clamp(min=0).square() + y.clamp(min=0).square())
        nearest = square.flatten(0, 1).amin(0).reshape(_WINDOW)
        level = OPEN - torch.stack([nearest < limit for limit in self._limits[:3]]).to(codes.dtype).sum(0)
        suspected = ((evidence == SUSPECTED) & rough).to(codes.dtype)
        near = PARTS**2 * (offset.square() + offset.square()[:, None]) < self._limits.doubt
        doubts = F.conv2d(
            F.pad(suspected[None, None], (reach,) * 4, mode="circular"), near[None, None].to(codes.dtype)
        )[0, 0]
        level = torch.where(doubts > 0.5, level.clamp(max=DOUBTFUL), level)
        return torch.where(evidence >= OCCUPIED, 0.0, level)


def _moved(cells: Tensor, shift: Tensor) -> Tensor:
    """Returns the cells ``[2, SIZE, SIZE]`` of a window that has moved by ``shift [2]`` columns and rows."""
    column, row = torch.arange(SIZE, device=cells.device) + shift.clamp(-SIZE, SIZE).long()[:, None]
    inside = ((row >= 0) & (row < SIZE))[:, None] & (column >= 0) & (column < SIZE)
    moved = cells[:, row.clamp(0, SIZE - 1)][:, :, column.clamp(0, SIZE - 1)]
    return torch.where(inside, moved, cells.new_tensor((0.0, UNSEEN))[:, None, None])


def _unpacked(codes: Tensor) -> tuple[Tensor, Tensor]:
    """Returns the evidence, ``[SIZE, SIZE]``, and the sides of boxes, ``[4, SIZE, SIZE]``; -1 in free cells."""
    digits = (codes / codes.new_tensor(_DIGITS)[:, None, None]).floor() % 16
    return digits[0], torch.where(digits[0] >= OCCUPIED, digits[1:], -1.0)


def _in_cells(scan: Scan, points: Tensor, counts: Tensor, values: Tensor, none: float, reduce: str) -> Tensor:
    """Reduces (``"sum"``, ``"amax"``) the ``values [k, n]`` of the points in each cell that count: ``[k, SIZE, SIZE]``.

    ``points [n, 2]`` are in cells, and ``none`` is the value of cells without any.
    """
    column, row = ((points.floor() - scan.center + HALF).long() % SIZE).unbind(-1)
    # Points that do not count are collected behind the last cell.
    cell = torch.where(counts, row * SIZE + column, SIZE * SIZE).expand(values.shape)
    cells = values.new_full((len(values), SIZE * SIZE + 1), none).scatter_reduce(1, cell, values, reduce)
    return cells[:, :-1].reshape(-1, *_WINDOW)


def _boxes(scan: Scan, points: Tensor, counts: Tensor) -> Tensor:
    """Returns the sides of the box of the points in each cell, ``[4, SIZE, SIZE]``; -1 without any."""
    part = ((points - points.floor()) * PARTS).trunc().clamp(0, PARTS - 1)
    sides = torch.stack((PARTS - 1 - part, part), -1).flatten(1).T
    return _in_cells(scan, points, counts, sides, -1.0, "amax")


def _along(start: Tensor, vectors: Tensor, lengths: Tensor, last: int) -> tuple[Tensor, Tensor]:
    """Returns the numbers 1 to ``last``, and the points that many cells along vectors of these lengths."""
    number = torch.arange(1, last + 1, device=start.device)[:, None]
    return number, start + (number / lengths)[..., None] * vectors


def _with_scan(codes: Tensor, walls: Tensor, scan: Scan) -> Tensor:
    """Returns what is known of the cells after a scan: see ``add_scans`` in ``scan_kernels``. Walls are too steep."""
    (evidence, sides), origin = _unpacked(codes), scan.origin[0]
    beams, hits, was_closed = scan.beams[0, :, :2], scan.hits[0], evidence > MOST
    ends = origin + beams
    crossed = beams.abs().amax(-1)
    number, points = _along(origin, beams, crossed, REACH)
    passes = (number <= crossed - 1.5).flatten()
    ones = torch.ones_like(points[..., 0]).reshape(1, -1)
    evidence = (evidence - _in_cells(scan, points.flatten(0, 1), passes, ones, 0.0, "sum")[0]).clamp(min=0.0)
    occupied = was_closed | (evidence >= OCCUPIED)
    hit = _in_cells(scan, ends, hits, ones[:, : len(ends)], 0.0, "sum")[0]
    evidence = torch.where(was_closed, float(CLOSED), (evidence + HIT * hit).clamp(max=MOST))
    boxes = torch.where(was_closed, -1.0, _boxes(scan, ends, hits))
    sides = torch.maximum(torch.where(occupied, sides, -1.0), boxes)
    gap = beams.roll(-1, 0) - beams
    steps, both = gap.abs().amax(-1).ceil(), hits & hits.roll(-1) & (gap.norm(dim=-1) < NO_GAP)
    number, points = _along(ends, gap, steps, math.ceil(NO_GAP) - 1)
    between = _boxes(scan, points.flatten(0, 1), (both & (number < steps)).flatten())
    evidence = torch.where(between[0] >= 0, evidence.clamp(min=OCCUPIED), evidence)
    sides = torch.maximum(sides, between)
    doubt = _in_cells(scan, ends, scan.doubts[0], ones[:, : len(ends)], 0.0, "sum")[0]
    evidence = torch.where(doubt > 0, evidence.clamp(min=SUSPECTED), evidence)
    middle = codes.new_tensor((PARTS - 1 - PARTS // 2, PARTS // 2) * 2)[:, None, None]
    steep = torch.where(walls & (evidence != CLOSED), middle, -1.0)
    for closed in (steep, _boxes(scan, scan.closed[0], scan.closes[0])):
        evidence = torch.where(closed[0] >= 0, float(CLOSED), evidence)
        sides = torch.maximum(sides, closed)
    digits = torch.cat((evidence[None], sides.clamp(min=0.0)))
    return (digits * codes.new_tensor(_DIGITS)[:, None, None]).sum(0)


def _walls(heights: Tensor) -> Tensor:
    """Returns the cells halfway between two whose heights differ too much: see ``close_steep`` in ``scan_kernels``."""
    padded, near = F.pad(heights, (_HALFWAY,) * 4, value=UNSEEN), range(2 * _HALFWAY + 1)
    rows = [padded.narrow(0, row, SIZE) for row in near]
    around = {(row, column): rows[row].narrow(1, column, SIZE) for row, column in product(near, repeat=2)}
    seen = {place: cells > UNSEEN for place, cells in around.items()}
    closed = torch.zeros_like(heights, dtype=torch.bool)
    for offset in product(range(-STRETCH, STRETCH + 1), repeat=2):
        distance = math.hypot(*offset)
        if 0 < distance <= STRETCH:
            # The cell halfway, rounded to the higher one.
            row, column = (_HALFWAY - int(math.copysign((abs(part) + 1) // 2, part)) for part in offset)
            rise = around[row + offset[0], column + offset[1]] - around[row, column]
            closed = closed | (seen[row, column] & (rise > math.tan(MAX_TILT) * CELL * (distance + 1.0)))
    return closed


def _plan(levels: Tensor, goal: Tensor, edges: Tensor) -> tuple[Tensor, Tensor]:
    """Plans the route from the middle of the window to a cell: see ``plan_routes`` in ``route_kernels``.

    Columns and rows are those of the goal, int64 ``[2]``, of the ``edges`` at the bounds, ``[4]``, and of the first two
    corners, ``[2, 2]``, -1 for the goal. The length is in m.
    """
    weights = _weights(levels, goal, edges)
    costs = _costs(weights, goal)
    total = costs[HALF, HALF]
    reachable = total < routes.UNKNOWN_COST
    corners = _corners(levels, costs, weights, goal, torch.where(reachable, torch.full_like(goal, HALF), goal))
    return corners, torch.where(reachable, total * CELL / (routes.OPEN_WEIGHT * routes.STRAIGHT), -1.0)


def _weights(levels: Tensor, goal: Tensor, edges: Tensor) -> Tensor:
    """Returns the weights of the cells, ``[SIZE, SIZE]``; ``UNKNOWN_COST`` where the rover cannot be."""
    number = torch.arange(SIZE, device=levels.device)
    column, row = number, number[:, None]
    from_home = torch.maximum((column - HALF).abs(), (row - HALF).abs())
    from_goal = torch.maximum((column - goal[0]).abs(), (row - goal[1]).abs())
    none, is_goal = float(routes.UNKNOWN_COST), from_goal == 0
    by_level = levels.new_tensor(
        (none, routes.BESIDE_WEIGHT, routes.NEAR_WEIGHT, routes.SLOW_WEIGHT, routes.OPEN_WEIGHT)
    )
    weights = by_level[levels.long()]
    weights = torch.where((levels == 1) & (torch.minimum(from_home, from_goal) > routes.BESIDE), none, weights)
    weights = torch.where((levels == 0) & is_goal, float(routes.OPEN_WEIGHT), weights)
    inside = (column >= edges[0] + routes.ROOM) & (row >= edges[1] + routes.ROOM)
    inside = inside & (column <= edges[2] - routes.ROOM) & (row <= edges[3] - routes.ROOM)
    return torch.where(inside | is_goal, weights, none)


def _costs(weights: Tensor, goal: Tensor) -> Tensor:
    """Returns the costs from the goal, ``[SIZE, SIZE]``, exact in all cells that cost no more than the rover's.

    Each cell takes the lowest cost over the steps from its neighbors, until no such cell changes any more. Costs are
    integers below 2^24, which floats hold exactly.
    """
    number = torch.arange(SIZE, device=weights.device)
    is_goal = (number == goal[0]) & (number[:, None] == goal[1])

    def lowest(values: Tensor, rows: int, columns: int) -> Tensor:
        return -F.max_pool2d(-values[None], (rows, columns), 1, (rows // 2, columns // 2))[0]

    def sweep(costs: Tensor, going: Tensor) -> tuple[Tensor, Tensor]:
        after = costs
        for _ in range(_SWEEPS):
            straight, diagonal = after + routes.STRAIGHT * weights, after + routes.DIAGONAL * weights
            aside = torch.minimum(lowest(straight, 1, 3), lowest(straight, 3, 1))
            after = torch.minimum(after, torch.minimum(aside, lowest(diagonal, 3, 3)))
        return after, ((after < costs) & (after <= after[HALF, HALF])).any()

    start = torch.where(is_goal, 0.0, float(routes.UNKNOWN_COST))
    return _repeat(lambda costs, going: going.clone(), sweep, (start, is_goal.any()))[0]


def _corners(levels: Tensor, costs: Tensor, weights: Tensor, goal: Tensor, start: Tensor) -> Tensor:
    """Finds up to two corners of the cheapest path by string pulling: see ``find_corners`` in ``route_kernels``."""
    device = levels.device
    steps, direction = torch.tensor(_STEPS, device=device), torch.arange(8, device=device)
    lengths = torch.where(direction % 2 == 0, float(routes.STRAIGHT), float(routes.DIAGONAL))
    numbers, index = torch.arange(1, routes.LONGEST, device=device), torch.arange(2, device=device)[:, None]

    def at(values: Tensor, cells: Tensor) -> Tensor:
        column, row = cells.clamp(0, SIZE - 1).unbind(-1)
        # An index without dimensions cannot be exported.
        return values.flatten().index_select(0, (SIZE * row + column).flatten()).reshape(row.shape)

    def going(n: Tensor, cell: Tensor, step: Tensor, first: Tensor, walked: Tensor, least: Tensor, found: Tensor):
        return (n < routes.LONGEST) & (found[1, 0] < 0) & (cell != goal).any()

    def walk(n: Tensor, cell: Tensor, step: Tensor, first: Tensor, walked: Tensor, least: Tensor, found: Tensor):
        around = cell + steps
        inside = ((around >= 0) & (around < SIZE)).all(-1)
        cost = torch.where(inside, at(costs, around) + lengths * at(weights, around), float(routes.UNKNOWN_COST)).long()
        # Of equally cheap steps, the path takes that which goes on ahead, or the first.
        step = (16 * cost + torch.where(direction == step, -1, direction)).argmin()
        following = cell + steps.index_select(0, step.reshape(1))[0]
        level = at(levels, following)
        least, way = torch.minimum(least, level), following - first
        count = way.abs().amax(0)
        line = first + ((numbers / count)[:, None] * way + 0.5).floor().long()
        lowest = torch.where(numbers < count, at(levels, line), float(OPEN)).amin(0)
        is_corner = (walked >= routes.NEAREST) & (lowest < least)
        found = torch.where(is_corner & (index == (found[0, 0] >= 0).long()), cell, found)
        first, least = torch.where(is_corner, cell, first), torch.where(is_corner, level, least)
        return n + 1, following, step, first, torch.where(is_corner, 0, walked) + 1, least, found

    zero = torch.zeros((), dtype=torch.int64, device=device)
    none = zero - torch.ones_like(steps[:2])
    state = (zero, start, zero - 1, start + 0, zero + 0, levels.new_tensor(float(OPEN)), none)
    return _repeat(going, walk, state)[-1]


def _repeat(
    condition: Callable[..., Tensor], body: Callable[..., tuple[Tensor, ...]], state: tuple[Tensor, ...]
) -> tuple[Tensor, ...]:
    """Applies ``body`` to the state while ``condition`` holds. An exported program holds the loop itself."""
    if torch.compiler.is_exporting():
        return while_loop(condition, body, state)
    while condition(*state):
        state = body(*state)
    return state
