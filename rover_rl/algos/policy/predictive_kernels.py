"""Warp kernels of :mod:`rover_rl.algos.policy.predictive`: costs to go in space and time, and drives."""

from __future__ import annotations

from rover_rl.native.warp import wp

SIZE, CELL = wp.constant(96), wp.constant(0.2)  # number of cells along a side of the window, and their side, m
LAYERS = wp.constant(40)  # number of instants of a plan, besides that of its beginning
REACHED = wp.constant(4.0)  # distance added to that up to which a plan matters at an instant, in cells
EASY = wp.constant(0.34)  # distance beyond that of a blocked cell from which on an obstacle costs nothing, m
UNEASE = wp.constant(1.5)  # extra cost of a second right beside an obstacle, s
COLLISION = wp.constant(20.0)  # cost of a blocked cell, s
# Time that a meter in a blocked cell costs on the map, and cost of cells whose cost is not known, s.
THROUGH, FAR = wp.constant(20.0), wp.constant(1.0e4)
SWEEPS = wp.constant(3)  # number of sweeps over the window in each of four directions

DRIVE_DT = wp.constant(0.1)  # time step of a drive, s
FIRST, SECOND = wp.constant(7), wp.constant(15)  # number of steps of the two parts of a drive
SPEEDS = wp.constant(5)  # number of forward speeds, from full speed backward to full speed ahead
TURNS, SECOND_TURNS = wp.constant(11), wp.constant(7)  # number of yaw rates in the first and in the second part
# Clearance of the body below which a drive costs more, m, and extra costs of a second in contact and backward, s.
CLOSE, CLOSE_COST, BACKWARD_COST = wp.constant(0.12), wp.constant(4.0), wp.constant(0.1)
CRASH = wp.constant(1000.0)  # cost of a drive that collides at once, s. Later is better.

State = wp.types.vector(6, float)  # x, y, heading, speed, yaw rate, and cost so far


@wp.struct
class Around:
    """What is around the rovers, m."""

    frame: wp.array[wp.vec3]  # x and y of the first point of each row's grid of distances, and its spacing
    side: int  # number of points along a side of the grids
    clearance: wp.array2d[float]  # distances to what does not move, row by row
    places: wp.array3d[wp.vec2]  # of the movers of each row and instant
    radius: wp.array2d[float]  # of the movers. Those without any are last.


@wp.struct
class Plans:
    """Plans of all rows."""

    origins: wp.array[wp.vec2]  # x and y of cell 0 of each row's window, m
    goals: wp.array[wp.vec2]  # m
    goal_radius: float  # distance from the goal at which it is reached, m
    dt: float  # time from one instant to the next, s
    speed: float  # largest speed, m/s
    blocked: float  # distance of the center from an obstacle below which a cell is blocked, m
    costs: wp.array3d[float]  # costs to go, s, [N, LAYERS + 1, SIZE * SIZE]


@wp.struct
class Body:
    """What a drive depends on of the robot."""

    front: float  # distance of the two discs that cover the robot from its center, m
    radius: float  # of these discs, m
    acceleration: float  # m/s^2
    speed: float  # m/s
    yaw_acceleration: float  # of the body, rad/s^2
    yaw_rate: float  # of the body, rad/s
    turning: float  # least radius of a turn, m


@wp.func
def between(values: wp.array[float], first: wp.vec2, spacing: float, side: int, x: float, y: float):
    """Value at a point between those on a grid, row by row, the first of which is at ``first``."""
    u = wp.clamp((x - first[0]) / spacing, 0.0, float(side - 1) - 0.001)
    v = wp.clamp((y - first[1]) / spacing, 0.0, float(side - 1) - 0.001)
    i = int(u)
    j = int(v)
    s = u - float(i)
    t = v - float(j)
    k = j * side + i
    low = (1.0 - s) * values[k] + s * values[k + 1]
    high = (1.0 - s) * values[k + side] + s * values[k + side + 1]
    return (1.0 - t) * low + t * high


@wp.func
def fixed_distance(around: Around, row: int, x: float, y: float):
    """Distance of a point to what does not move, m."""
    frame = around.frame[row]
    return between(around.clearance[row], wp.vec2(frame[0], frame[1]), frame[2], around.side, x, y)


@wp.func
def moving_distance(around: Around, row: int, instant: int, x: float, y: float, limit: float):
    """Distance of a point to the nearest mover, at most ``limit``, m."""
    nearest = limit
    for m in range(around.radius.shape[1]):
        radius = around.radius[row, m]
        if radius == 0.0:
            break
        nearest = wp.min(nearest, wp.length(wp.vec2(x, y) - around.places[row, instant, m]) - radius)
    return nearest


@wp.func
def cost_at(plans: Plans, row: int, layer: int, x: float, y: float):
    """Cost to go at a point, s."""
    return between(plans.costs[row, layer], plans.origins[row], CELL, SIZE, x, y)


@wp.kernel
def sweep(layer: int, steps: wp.array[wp.vec2], around: Around, plans: Plans):
    """Costs to go at an instant, from those at the next one; a thread does a cell of a row.

    Cells that the rover, in the middle of the window, cannot reach until then have the last costs. ``layer`` is the
    number of the instant, and ``steps`` are ways from one instant to the next, m.
    """
    row, k = wp.tid()
    costs = plans.costs
    origin = plans.origins[row]
    x = origin[0] + CELL * float(k % SIZE)
    y = origin[1] + CELL * float(k / SIZE)
    across = float(k % SIZE - SIZE / 2)
    along = float(k / SIZE - SIZE / 2)
    reach = float(layer) * wp.length(steps[0]) / CELL + REACHED
    if across * across + along * along > reach * reach:
        costs[row, layer, k] = costs[row, LAYERS, k]
        return
    if wp.length(plans.goals[row] - wp.vec2(x, y)) < plans.goal_radius:
        costs[row, layer, k] = 0.0
        return
    clearance = moving_distance(around, row, layer, x, y, plans.blocked + EASY)
    clearance = wp.min(clearance, fixed_distance(around, row, x, y))
    if clearance < plans.blocked:
        costs[row, layer, k] = COLLISION + cost_at(plans, row, layer + 1, x, y) * 0.5
        return
    best = cost_at(plans, row, layer + 1, x, y)
    for h in range(steps.shape[0]):
        best = wp.min(best, cost_at(plans, row, layer + 1, x + steps[h][0], y + steps[h][1]))
    unease = UNEASE * (plans.blocked + EASY - clearance) / EASY
    costs[row, layer, k] = best + plans.dt * (1.0 + wp.max(unease, 0.0))


@wp.func
def begin_cell(row: int, k: int, around: Around, plans: Plans):
    """Sets the time per meter in a cell, in the first layer, which is not needed yet, and the cost if it is known."""
    origin = plans.origins[row]
    goal = plans.goals[row]
    x = origin[0] + CELL * float(k % SIZE)
    y = origin[1] + CELL * float(k / SIZE)
    clearance = fixed_distance(around, row, x, y)
    unease = UNEASE * wp.clamp((plans.blocked + EASY - clearance) / EASY, 0.0, 1.0)
    plans.costs[row, 0, k] = (1.0 + unease) / plans.speed + wp.where(clearance < plans.blocked, THROUGH, 0.0)
    ahead = goal - origin
    last = CELL * float(SIZE - 1)
    inside = wp.min(ahead[0], ahead[1]) >= 0.0 and wp.max(ahead[0], ahead[1]) <= last
    at_edge = k % SIZE == 0 or k % SIZE == SIZE - 1 or k / SIZE == 0 or k / SIZE == SIZE - 1
    way = wp.length(goal - wp.vec2(x, y))
    known = (inside and way < 1.5 * CELL) or (at_edge and not inside)
    plans.costs[row, LAYERS, k] = wp.where(known, way / plans.speed, FAR)


@wp.func
def relax(row: int, x: int, y: int, costs: wp.array3d[float]):
    """Lowers the last cost of a cell to the least way over its neighbors."""
    k = y * SIZE + x
    best = costs[row, LAYERS, k]
    pace = costs[row, 0, k]
    for dy in range(-1, 2):
        for dx in range(-1, 2):
            to_x = wp.clamp(x + dx, 0, SIZE - 1)
            to_y = wp.clamp(y + dy, 0, SIZE - 1)
            way = CELL * wp.sqrt(float(dx * dx + dy * dy))
            best = wp.min(best, costs[row, LAYERS, to_y * SIZE + to_x] + way * pace)
    costs[row, LAYERS, k] = best


@wp.kernel
def fixed_costs(around: Around, plans: Plans):
    """Costs to go of the last instant, among what does not move; a thread does a row.

    Fast sweeping (H. Zhao, "A fast sweeping method for eikonal equations", Mathematics of Computation 74, 2005) over
    the eight neighbors of each cell, in four directions in turn. From the edges of the window, the way to a goal
    outside of it is straight. A meter in a blocked cell costs ``THROUGH`` seconds more. The layers before the last one
    are overwritten.
    """
    row = wp.tid()
    for k in range(SIZE * SIZE):
        begin_cell(row, k, around, plans)
    for direction in range(4 * SWEEPS):
        for n in range(SIZE):
            y = wp.where((direction & 1) > 0, SIZE - 1 - n, n)
            for m in range(SIZE):
                relax(row, wp.where((direction & 2) > 0, SIZE - 1 - m, m), y, plans.costs)


@wp.func
def approach(value: float, target: float, most: float):
    return value + wp.clamp(target - value, -most, most)


@wp.func
def drive_step(row: int, number: int, before: State, speed: float, yaw_rate: float, body: Body, around: Around):
    """State after a step of a drive towards a speed and a yaw rate. After a collision, the cost is near ``CRASH``."""
    v = approach(before[3], speed, body.acceleration * DRIVE_DT)
    w = approach(before[4], yaw_rate, body.yaw_acceleration * DRIVE_DT)
    middle = before[2] + 0.5 * w * DRIVE_DT
    x = before[0] + v * DRIVE_DT * wp.cos(middle)
    y = before[1] + v * DRIVE_DT * wp.sin(middle)
    heading = before[2] + w * DRIVE_DT
    dx = body.front * wp.cos(heading)
    dy = body.front * wp.sin(heading)
    limit = body.radius + CLOSE
    near = wp.min(fixed_distance(around, row, x + dx, y + dy), limit)
    near = wp.min(near, fixed_distance(around, row, x - dx, y - dy))
    near = moving_distance(around, row, number, x + dx, y + dy, near)
    near = moving_distance(around, row, number, x - dx, y - dy, near)
    cost = before[5] + DRIVE_DT * (1.0 + CLOSE_COST * (limit - near) / CLOSE)
    if speed < 0.0:
        cost += BACKWARD_COST * DRIVE_DT
    if near < body.radius:
        cost = before[5] + CRASH - 100.0 * DRIVE_DT * float(number)
    return State(x, y, heading, v, w, cost)


@wp.kernel
def drive(states: wp.array2d[float], body: Body, around: Around, plans: Plans, results: wp.array2d[float]):
    """Least cost of the drives that begin with a speed and a yaw rate; a thread does one pair of a row.

    ``states`` are x, y, heading, speed and yaw rate of each row, ``around`` has the movers at the steps of a drive, and
    ``results`` are the least costs, s, ``[N, SPEEDS * TURNS]``.
    """
    row, pair = wp.tid()
    goal = plans.goals[row]
    half = float((SPEEDS - 1) / 2)
    speed = body.speed * (float(pair / TURNS) / half - 1.0)
    yaw_rate = body.yaw_rate * (2.0 * float(pair % TURNS) / float(TURNS - 1) - 1.0)
    state = State(states[row, 0], states[row, 1], states[row, 2], states[row, 3], states[row, 4], 0.0)
    if wp.abs(yaw_rate) * body.turning > wp.abs(speed) + 1.0e-6:
        results[row, pair] = 2.0 * CRASH
        return
    number = int(0)
    while number < FIRST:
        number += 1
        state = drive_step(row, number, state, speed, yaw_rate, body, around)
        if state[5] > 500.0 or wp.length(goal - wp.vec2(state[0], state[1])) < plans.goal_radius:
            results[row, pair] = state[5]
            return
    best = float(3.0 * CRASH)
    for second in range(SPEEDS * SECOND_TURNS):
        speed2 = body.speed * (float(second / SECOND_TURNS) / half - 1.0)
        yaw_rate2 = body.yaw_rate * (2.0 * float(second % SECOND_TURNS) / float(SECOND_TURNS - 1) - 1.0)
        if wp.abs(yaw_rate2) * body.turning <= wp.abs(speed2) + 1.0e-6:
            next = state
            number = int(FIRST)
            ended = int(0)
            while number < FIRST + SECOND and ended == 0:
                number += 1
                next = drive_step(row, number, next, speed2, yaw_rate2, body, around)
                if next[5] > best or wp.length(goal - wp.vec2(next[0], next[1])) < plans.goal_radius:
                    ended = 1
            if ended == 0:
                layer = wp.min(int(DRIVE_DT * float(number) / plans.dt + 0.5), LAYERS)
                next[5] = next[5] + cost_at(plans, row, layer, next[0], next[1])
            best = wp.min(best, next[5])
    results[row, pair] = best
