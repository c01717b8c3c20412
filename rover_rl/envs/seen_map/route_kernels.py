"""Warp kernels that plan routes on maps of seen obstacles, and close the ways of what moves on them.

What has not been seen counts as free. A step to a neighboring cell costs its length (``STRAIGHT`` or ``DIAGONAL``)
times the weight of the cell that is nearer to the goal. Weights grow near obstacles. All costs are integers.

The map changes with each scan, and each rover has its own, so that this search, A*, looks at few of its cells. That of
:mod:`rover_rl.sims.free_space.path_kernels` finds the costs from all cells of a known world.
"""

from __future__ import annotations

from rover_rl.envs.seen_map.scan_kernels import CELL, CROSSED, DOUBTFUL, HALF, LAST, OPEN, SIZE, address
from rover_rl.native.warp import wp
from rover_rl.sims.free_space.path_kernels import link, unlink

STRAIGHT, DIAGONAL = wp.constant(5), wp.constant(7)  # lengths of steps along an axis, and diagonally
OPEN_WEIGHT = wp.constant(2)  # weight of a cell that is far from obstacles, and the smallest one
SLOW_WEIGHT = wp.constant(3)  # weight of a cell of level 3, where the rover should be slow
NEAR_WEIGHT = wp.constant(6)  # weight of a cell of level 2, where it hardly fits
ROOM = wp.constant(2)  # number of cells to the bounds, at least: 0.3 m
# Number of cells from start and goal within which the route may run right beside obstacles, and the weight of a cell
# there. The route may begin and end beside an obstacle, but prefers a detour to running along it.
BESIDE, BESIDE_WEIGHT = wp.constant(4), wp.constant(40)
UNKNOWN_COST = wp.constant(1 << 30)  # cost of a cell that no path has reached yet
# Number of buckets of the queue, and range of the costs in a bucket. A step changes the cost with the estimate by at
# most 7 * 40 + 14 < 63 * WIDTH.
BUCKETS, WIDTH = wp.constant(64), wp.constant(8)
REMOVED = wp.constant(-2)  # follower of a cell that has left the queue
# Number of cells along the route to its first corner, at least, so that the corner's direction is steady: 0.6 m.
NEAREST = wp.constant(4)
LONGEST = wp.constant(96)  # number of cells along the route within which its corners are sought

STEPS, STEP_DT = wp.constant(16), wp.constant(0.25)  # number of instants at which what moves is looked at, and time, s
EARLY = wp.constant(0.75)  # time before and after the rover could be in a cell, in which the cell is closed, s
TIGHT = wp.constant(1)  # level of closed cells in a plan: the rover does not fit there, but gets out if it is there


@wp.func
def side_of(step: int):
    """Returns on which side along x neighbor 0 to 7 lies, counter-clockwise from +x: -1, 0 or 1."""
    return wp.where(step % 4 == 2, 0, wp.where((step + 1) % 8 < 3, 1, -1))


@wp.func
def neighbor(step: int):
    """Returns the offset of neighbor 0 to 7."""
    return wp.vec2i(side_of(step), side_of((step + 6) % 8))


@wp.func
def step_length(step: int):
    return wp.where(step % 2 == 0, STRAIGHT, DIAGONAL)


@wp.func
def least_cost(x: int, y: int):
    """Returns the cost of the straight way between two cells that are (x, y) apart, if all is free."""
    most = wp.max(wp.abs(x), wp.abs(y))
    least = wp.min(wp.abs(x), wp.abs(y))
    return OPEN_WEIGHT * (STRAIGHT * (most - least) + DIAGONAL * least)


@wp.struct
class Window:
    """The cells that a route is planned on, addressed within the window: the rover's is (HALF, HALF)."""

    center: wp.vec2i  # cell of the world in the middle of the window
    goal: int  # cell of the goal, row * SIZE + column
    fence: wp.vec4i  # first column and row, and last column and row, that a route may lead through
    levels: wp.array[wp.uint8]
    doubts: wp.array[wp.int16]


@wp.func
def level_of(x: int, y: int, window: Window):
    """Returns the level of cell (x, y), with suspected cells around it."""
    cell = address(x + window.center[0] - HALF, y + window.center[1] - HALF)
    level = int(window.levels[cell])
    level = wp.where(level >= CROSSED, TIGHT, level)
    return wp.where(window.doubts[cell] > wp.int16(0), wp.min(level, DOUBTFUL), level)


@wp.func
def weight_of(x: int, y: int, window: Window):
    """Returns the weight of cell (x, y); 0 if the rover cannot be there."""
    level = level_of(x, y, window)
    is_goal = y * SIZE + x == window.goal
    weight = int(OPEN_WEIGHT)
    if level == 3:
        weight = SLOW_WEIGHT
    elif level == 2:
        weight = NEAR_WEIGHT
    elif level == 1:
        # The rover does not fit. But beside a wall, start and goal may seem to be so.
        from_home = wp.max(wp.abs(x - HALF), wp.abs(y - HALF))
        from_goal = wp.max(wp.abs(x - (window.goal & LAST)), wp.abs(y - window.goal / SIZE))
        weight = wp.where(wp.min(from_home, from_goal) > BESIDE, 0, BESIDE_WEIGHT)
    elif level == 0 and not is_goal:
        weight = 0
    fence = window.fence
    if x < fence[0] or y < fence[1] or x > fence[2] or y > fence[3]:
        weight = wp.where(is_goal, weight, 0)
    return weight


@wp.func
def spread(
    window: Window,
    costs: wp.array[int],
    heads: wp.array[int],
    following: wp.array[int],
    preceding: wp.array[int],
    reached: wp.array[int],
):
    """Computes the costs from the goal to all cells that may be on a cheapest path to the center.

    Lists the cells whose costs it has ``reached``, and returns their number.

    A* from the goal (P. E. Hart, N. J. Nilsson, B. Raphael, "A formal basis for the heuristic determination of minimum
    cost paths", IEEE Transactions on Systems Science and Cybernetics 4, 1968) with a circular queue of buckets. It ends
    when no cell with a lower or equal cost is left, so that the costs along *all* cheapest paths are exact.
    """
    for bucket in range(BUCKETS):
        heads[bucket] = -1
    home = int(HALF * SIZE + HALF)
    goal = window.goal
    costs[goal] = 0
    reached[0] = goal
    count = int(1)
    level = least_cost((goal & LAST) - HALF, goal / SIZE - HALF) / WIDTH
    link(goal, level % BUCKETS, heads, following, preceding)
    empty = int(0)
    # With an empty queue, or once the home's cost is below those in the queue, all is known.
    while empty < BUCKETS and level * WIDTH <= costs[home]:
        cell = heads[level % BUCKETS]
        if cell < 0:
            level += 1
            empty += 1
        else:
            empty = int(0)
            unlink(cell, level % BUCKETS, heads, following, preceding)
            following[cell] = REMOVED
            here = costs[cell]
            x = cell & LAST
            y = cell / SIZE
            weight = weight_of(x, y, window)
            for step in range(8):
                offset = neighbor(step)
                to_x = x + offset[0]
                to_y = y + offset[1]
                # The path ends at home.
                if cell != home and to_x >= 0 and to_y >= 0 and to_x < SIZE and to_y < SIZE:
                    other = to_y * SIZE + to_x
                    candidate = here + step_length(step) * weight
                    known = costs[other]
                    if candidate < known and (other == home or weight_of(to_x, to_y, window) > 0):
                        estimate = least_cost(to_x - HALF, to_y - HALF)
                        if known == UNKNOWN_COST:
                            reached[count] = other
                            count += 1
                        elif following[other] != REMOVED:
                            unlink(other, (known + estimate) / WIDTH % BUCKETS, heads, following, preceding)
                        costs[other] = candidate
                        link(other, (candidate + estimate) / WIDTH % BUCKETS, heads, following, preceding)
    return count


@wp.func
def edge(coordinate: float, center: int):
    """Returns the number within the window of the cell that holds a coordinate, m; outside of it, one ``ROOM`` away."""
    return wp.clamp(int(wp.floor(wp.clamp(coordinate / CELL, -1.0e8, 1.0e8))) - center + HALF, -ROOM, SIZE - 1 + ROOM)


@wp.func
def next_step(x: int, y: int, before: int, window: Window, costs: wp.array[int]):
    """Returns the step of a cheapest path from a cell: of equally cheap ones that which goes on ahead, or the first."""
    best = int(UNKNOWN_COST)
    chosen = int(0)
    for step in range(8):
        offset = neighbor(step)
        to_x = x + offset[0]
        to_y = y + offset[1]
        if to_x >= 0 and to_y >= 0 and to_x < SIZE and to_y < SIZE:
            weight = weight_of(to_x, to_y, window)
            known = costs[to_y * SIZE + to_x]
            if weight > 0 and known < UNKNOWN_COST:
                cost = known + step_length(step) * weight
                if cost < best or (cost == best and step == before):
                    best = cost
                    chosen = step
    return chosen


@wp.func
def is_open(from_x: int, from_y: int, to_x: int, to_y: int, least: int, window: Window):
    """Returns whether all cells between two cells of the window have at least the level ``least``."""
    count = wp.max(wp.abs(to_x - from_x), wp.abs(to_y - from_y))
    for n in range(1, count):
        part = float(n) / float(count)
        x = from_x + int(wp.floor(part * float(to_x - from_x) + 0.5))
        y = from_y + int(wp.floor(part * float(to_y - from_y) + 0.5))
        if level_of(x, y, window) < least:
            return False
    return True


@wp.func
def set_point(points: wp.array2d[float], k: int, point: wp.vec2):
    points[k, 0] = point[0]
    points[k, 1] = point[1]


@wp.func
def find_corners(window: Window, costs: wp.array[int], corners: wp.array2d[float], path: wp.array2d[float]):
    """Finds up to two ``corners`` of the cheapest path by string pulling, and as many as ``path`` has room for.

    A corner is the last cell of the path up to which the straight line from the corner before, first from the rover, is
    as far from obstacles as the path itself.
    """
    x = int(HALF)
    y = int(HALF)
    start_x = int(HALF)
    start_y = int(HALF)
    # Number of cells since the last corner, and their lowest level.
    walked = int(0)
    least = int(OPEN)
    found = int(0)
    step = int(-1)
    n = int(0)
    while y * SIZE + x != window.goal and ((n < LONGEST and found < 2) or found < path.shape[0]):
        step = next_step(x, y, step, window, costs)
        offset = neighbor(step)
        level = level_of(x + offset[0], y + offset[1], window)
        least = wp.min(least, level)
        if walked >= NEAREST and not is_open(start_x, start_y, x + offset[0], y + offset[1], least, window):
            corner = wp.vec2(float(x + window.center[0] - HALF) + 0.5, float(y + window.center[1] - HALF) + 0.5) * CELL
            if n < LONGEST and found < 2:
                set_point(corners, found, corner)
            if found < path.shape[0]:
                set_point(path, found, corner)
            found += 1
            start_x = x
            start_y = y
            walked = 0
            least = level
        x += offset[0]
        y += offset[1]
        walked += 1
        n += 1


@wp.kernel
def plan_routes(
    goals: wp.array2d[float],
    bounds: wp.array2d[float],
    planned: wp.array[wp.bool],
    centers: wp.array[wp.vec2i],
    levels: wp.array2d[wp.uint8],
    doubts: wp.array2d[wp.int16],
    costs: wp.array2d[int],
    heads: wp.array2d[int],
    following: wp.array2d[int],
    preceding: wp.array2d[int],
    reached: wp.array2d[int],
    corners: wp.array3d[float],
    paths: wp.array3d[float],
    lengths: wp.array[float],
    first: int,
    last: int,
):
    """Plans the routes to the goals of rows ``first`` to ``last - 1``; thread ``t`` does every T-th one from ``t`` on.

    Args:
        goals, bounds: x and y of the goals, and lower and upper x and y of the area that routes stay in, m.
        planned: rows to plan for. The results of others do not change.
        centers, levels, doubts: cells in the middle of the windows, and the map: see ``scan_kernels.Cells``.
        costs, heads, following, preceding, reached: working memory, ``[T, SIZE * SIZE]``, and ``[T, BUCKETS]`` for
            ``heads``. Between plans, all costs are ``UNKNOWN_COST``.
        corners: results: x and y of the first two corners, ``[N, 2, 2]``, m; the goal if there are fewer, or no path.
        paths: the same of the first corners of the whole path, ``[N, K, 2]``.
        lengths: results: cost of the route, as the length of an open route of that cost, m; -1 without a path.
    """
    t = wp.tid()
    for i in range(first + t, last, costs.shape[0]):
        if planned[i]:
            center = centers[i]
            # A goal outside of the window counts as at its edge.
            column = wp.clamp(edge(goals[i, 0], center[0]), 0, SIZE - 1)
            row = wp.clamp(edge(goals[i, 1], center[1]), 0, SIZE - 1)
            window = Window()
            window.center = center
            window.goal = row * SIZE + column
            window.levels = levels[i]
            window.doubts = doubts[i]
            # The rover's center needs some room to the bounds, which may be infinite.
            window.fence = wp.vec4i(
                edge(bounds[i, 0], center[0]) + ROOM,
                edge(bounds[i, 1], center[1]) + ROOM,
                edge(bounds[i, 2], center[0]) - ROOM,
                edge(bounds[i, 3], center[1]) - ROOM,
            )
            count = spread(window, costs[t], heads[t], following[t], preceding[t], reached[t])
            total = costs[t, HALF * SIZE + HALF]
            lengths[i] = -1.0
            # The last corner is the goal itself.
            for k in range(2):
                set_point(corners[i], k, wp.vec2(goals[i, 0], goals[i, 1]))
            for k in range(paths.shape[1]):
                set_point(paths[i], k, wp.vec2(goals[i, 0], goals[i, 1]))
            if total < UNKNOWN_COST:
                lengths[i] = float(total) * CELL / float(OPEN_WEIGHT * STRAIGHT)
                find_corners(window, costs[t], corners[i], paths[i])
            for n in range(count):
                costs[t, reached[t, n]] = UNKNOWN_COST


@wp.kernel
def close_ways(
    planned: wp.array[wp.bool],
    centers: wp.array[wp.vec2i],
    places: wp.array2d[float],
    ways: wp.array3d[float],
    speeds: wp.array[float],
    levels: wp.array2d[wp.uint8],
    closes: bool,
    first: int,
):
    """Closes the cells where the rover would meet what moves, or opens them again.

    Thread ``(t, m)`` does so for mover ``m`` of row ``first + t``. Threads of one row that write to the same cell write
    the same.

    Lengths are in cells of the world. ``places`` and ``speeds`` are those of the rovers, and ``ways`` x, y, velocity
    along x and y, and radius of what moves, ``[N, K, 5]``; a negative one counts for nothing. ``CROSSED`` is added to
    the ``levels`` of cells that are closed.
    """
    t, m = wp.tid()
    i = t + first
    radius = ways[i, m, 4]
    if not planned[i] or radius <= 0.0:
        return
    center = centers[i]
    for n in range(STEPS):
        time = STEP_DT * float(n)
        x = ways[i, m, 0] + time * ways[i, m, 2]
        y = ways[i, m, 1] + time * ways[i, m, 3]
        # The rover can be in a ring around its place.
        inner = wp.max(time - EARLY, 0.0) * speeds[i]
        outer = (time + EARLY) * speeds[i]
        away = wp.length(wp.vec2(x - places[i, 0], y - places[i, 1]))
        if away - radius < outer and away + radius > inner:
            for row in range(int(wp.floor(y - radius)), int(wp.floor(y + radius)) + 1):
                v = float(row) + 0.5
                half = wp.sqrt(wp.max(radius * radius - (v - y) * (v - y), 0.0))
                # The cells whose middles are on the disc of the mover.
                for column in range(int(wp.ceil(x - half - 0.5)), int(wp.floor(x + half - 0.5)) + 1):
                    u = float(column) + 0.5
                    square = wp.length_sq(wp.vec2(u - places[i, 0], v - places[i, 1]))
                    in_window = wp.max(wp.abs(column - center[0]), wp.abs(row - center[1])) < HALF
                    if in_window and square > inner * inner and square < outer * outer:
                        cell = address(column, row)
                        level = int(levels[i, cell])
                        if closes and level > TIGHT and level < CROSSED:
                            levels[i, cell] = wp.uint8(level + CROSSED)
                        elif not closes and level >= CROSSED:
                            levels[i, cell] = wp.uint8(level - CROSSED)
