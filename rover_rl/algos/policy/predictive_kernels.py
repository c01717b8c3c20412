"""Warp kernels of :mod:`rover_rl.algos.policy.predictive`: costs to go in space and time, and drives."""

from __future__ import annotations

from rover_rl.native.warp import wp

SIZE, CELL = wp.constant(96), wp.constant(0.2)  # number of cells along a side of the window, and their side, m
LAYERS = wp.constant(40)  # number of instants of a plan, besides that of its beginning
REACHED = wp.constant(4.0)  # distance added to that up to which a plan matters at an instant, in cells
BORDER = wp.constant(2)  # number of cells at the edges of the window, from which a step may lead out of it
LANES = wp.constant(16)  # number of neighboring cells that are computed at once, in the vector registers of a CPU
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
ROUNDING = wp.constant(1.0e-3)  # more than what costs of a drive differ by, computed in two ways, s
CRASH = wp.constant(1000.0)  # cost of a drive that collides at once, s. Later is better.

Steps = wp.types.vector(int(SECOND), float)
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
    first: int  # instant at which drives end, before which no costs are needed
    steps: wp.array[int]  # ways from one instant to the next: numbers of cells, rounded down along both axes,
    shares: wp.array[wp.vec4]  # and the shares of the four cells around their ends
    costs: wp.array3d[float]  # costs to go at the last even and odd instants, s, [N, 2, SIZE * SIZE]
    fixed: wp.array2d[float]  # distances of the cells to what does not move, m, [N, SIZE * SIZE]
    clearance: wp.array2d[float]  # the same to movers, too, at an instant
    ahead: wp.array2d[float]  # least costs to go after a step, s; before that, time per meter, s/m


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
def cost_at(plans: Plans, row: int, x: float, y: float):
    """Cost to go at a point where a drive ends, s."""
    return between(plans.costs[row, plans.first % 2], plans.origins[row], CELL, SIZE, x, y)


@wp.func_native(
    """
const float* after = plans.costs.data + (2 * row + (instant + 1) % 2) * CELLS;
float* least = plans.ahead.data + row * CELLS;
for (int begin = first; begin < last; begin += LANES) {
    const int cell = begin < rest ? begin : rest;
    float best[LANES];
    for (int i = 0; i < LANES; ++i) best[i] = after[cell + i];
    for (int n = 0; n < plans.steps.shape[0]; ++n) {
        const wp::vec4 share = plans.shares.data[n];
        const float* low = after + cell + plans.steps.data[n];
        for (int i = 0; i < LANES; ++i) {
            const float cost =
                share[0] * low[i] + share[1] * low[i + 1] + share[2] * low[i + SIDE] + share[3] * low[i + SIDE + 1];
            best[i] = cost < best[i] ? cost : best[i];
        }
    }
    for (int i = 0; i < LANES; ++i) least[cell + i] = best[i];
}
for (int i = row * CELLS + first; i < row * CELLS + last; ++i) plans.clearance.data[i] = plans.fixed.data[i];
""".replace("CELLS", str(int(SIZE) ** 2))
    .replace("SIDE", str(int(SIZE)))
    .replace("LANES", str(int(LANES)))
)
def look_ahead(row: int, instant: int, first: int, last: int, rest: int, plans: Plans):
    """Sets the least costs after a step from the cells ``first`` to ``last`` of a line, and begins their clearances.

    ``rest`` is the last cell from which on the next ``LANES`` ones are not at the edge of the window.
    """
    ...


@wp.func_native(
    """
float* costs = plans.costs.data + (2 * row + instant % 2) * CELLS;
const float* after = plans.costs.data + (2 * row + (instant + 1) % 2) * CELLS;
const float* ahead = plans.ahead.data + row * CELLS;
const float* clearance = plans.clearance.data + row * CELLS;
for (int i = first; i < last; ++i) {
    const float near = plans.blocked + easy - clearance[i];
    const float free = ahead[i] + plans.dt * (1.0f + unease / easy * (near > 0.0f ? near : 0.0f));
    costs[i] = clearance[i] < plans.blocked ? collision + 0.5f * after[i] : free;
}
""".replace("CELLS", str(int(SIZE) ** 2))
)
def add_costs(
    row: int, instant: int, first: int, last: int, easy: float, unease: float, collision: float, plans: Plans
):
    """Sets the costs to go of cells from the least ones after a step, and from the clearances."""
    ...


@wp.func
def columns_within(center: wp.vec2, radius: float, line: int, first: int, last: int):
    """First and last column, between two, of the cells of a line within a radius (m) of a point in the window (m)."""
    across = CELL * float(line) - center[1]
    half = wp.sqrt(wp.max(radius * radius - across * across, 0.0))
    begin = wp.max(first, int(wp.ceil((center[0] - half) / CELL)))
    return begin, wp.where(wp.abs(across) < radius, wp.min(last, int(wp.ceil((center[0] + half) / CELL))), begin)


@wp.func
def plan_line(row: int, instant: int, line: int, first: int, last: int, around: Around, plans: Plans):
    """Costs to go at an instant, from those at the next one, of the cells of a line between two columns."""
    start = line * SIZE
    look_ahead(row, instant, start + first, start + last, start + SIZE - BORDER - LANES, plans)
    origin = plans.origins[row]
    for m in range(around.radius.shape[1]):
        radius = around.radius[row, m]
        if radius == 0.0:
            break
        place = around.places[row, instant, m] - origin
        begin, end = columns_within(place, radius + plans.blocked + EASY, line, first, last)
        for i in range(begin, end):
            away = wp.length(wp.vec2(CELL * float(i), CELL * float(line)) - place) - radius
            plans.clearance[row, start + i] = wp.min(plans.clearance[row, start + i], away)
    add_costs(row, instant, start + first, start + last, EASY, UNEASE, COLLISION, plans)
    begin, end = columns_within(plans.goals[row] - origin, plans.goal_radius, line, first, last)
    for i in range(begin, end):
        plans.costs[row, instant % 2, start + i] = 0.0


@wp.kernel
def sweep(last: int, first: int, way: float, around: Around, plans: Plans, lines: int, parts: int):
    """Costs to go at the instants from ``last`` back to ``first``, each from those at the next one.

    Thread ``(row, n, part)`` does every ``lines``-th line of a row, of which it does one of ``parts`` parts. ``way`` is
    that from one instant to the next, in cells. Cells that the rover, in the middle of the window, cannot reach until
    an instant keep the costs that they have.
    """
    row, n, part = wp.tid()
    width = (SIZE - 2 * BORDER + parts - 1) / parts
    begin = BORDER + part * width
    for back in range(last - first + 1):
        instant = last - back
        reach = CELL * (float(instant) * way + REACHED)
        middle = CELL * float(SIZE / 2)
        for line in range(BORDER + n, SIZE - BORDER, lines):
            low, high = columns_within(
                wp.vec2(middle, middle), reach, line, begin, wp.min(begin + width, SIZE - BORDER)
            )
            if low < high:
                plan_line(row, instant, line, low, high, around, plans)


@wp.func
def begin_cell(row: int, k: int, around: Around, plans: Plans):
    """Sets the distance of a cell to what does not move, the time per meter in it, and the cost if it is known."""
    origin = plans.origins[row]
    goal = plans.goals[row]
    x = origin[0] + CELL * float(k % SIZE)
    y = origin[1] + CELL * float(k / SIZE)
    clearance = fixed_distance(around, row, x, y)
    unease = UNEASE * wp.clamp((plans.blocked + EASY - clearance) / EASY, 0.0, 1.0)
    plans.fixed[row, k] = clearance
    plans.ahead[row, k] = (1.0 + unease) / plans.speed + wp.where(clearance < plans.blocked, THROUGH, 0.0)
    ahead = goal - origin
    last = CELL * float(SIZE - 1)
    inside = wp.min(ahead[0], ahead[1]) >= 0.0 and wp.max(ahead[0], ahead[1]) <= last
    at_edge = k % SIZE == 0 or k % SIZE == SIZE - 1 or k / SIZE == 0 or k / SIZE == SIZE - 1
    way = wp.length(goal - wp.vec2(x, y))
    known = (inside and way < 1.5 * CELL) or (at_edge and not inside)
    plans.costs[row, 0, k] = wp.where(known, way / plans.speed, FAR)


@wp.func_native(
    """
float* costs = plans.costs.data + 2 * row * SIDE * SIDE + SIDE * line;
const float* before = costs + SIDE * source;
const float* pace = plans.ahead.data + row * SIDE * SIDE + SIDE * line;
for (int i = 1; i < SIDE - 1; ++i) {
    const float aside = before[i - 1] < before[i + 1] ? before[i - 1] : before[i + 1];
    const float straight = before[i] + cell * pace[i], across = aside + 1.41421356f * cell * pace[i];
    const float least = straight < across ? straight : across;
    costs[i] = least < costs[i] ? least : costs[i];
}
for (int i = 1; i < SIDE - 1; ++i) {
    const float cost = costs[i - 1] + cell * pace[i];
    costs[i] = cost < costs[i] ? cost : costs[i];
}
for (int i = SIDE - 2; i > 0; --i) {
    const float cost = costs[i + 1] + cell * pace[i];
    costs[i] = cost < costs[i] ? cost : costs[i];
}
""".replace("SIDE", str(int(SIZE)))
)
def relax_line(row: int, line: int, source: int, cell: float, plans: Plans):
    """Lowers the last costs of a line to the least way over the line that is ``source`` after it, and over itself."""
    ...


@wp.kernel
def fixed_costs(around: Around, plans: Plans):
    """Costs to go of the last instant, among what does not move; a thread does a row.

    Fast sweeping (H. Zhao, "A fast sweeping method for eikonal equations", Mathematics of Computation 74, 2005) over
    the eight neighbors of each cell, line by line upward and downward in turn. From the edges of the window, the way to
    a goal outside of it is straight. A meter in a blocked cell costs ``THROUGH`` seconds more.
    """
    row = wp.tid()
    for k in range(SIZE * SIZE):
        begin_cell(row, k, around, plans)
    for _ in range(SWEEPS):
        for m in range(SIZE - 2):
            relax_line(row, m + 1, -1, CELL, plans)
        for m in range(SIZE - 2):
            relax_line(row, SIZE - 2 - m, 1, CELL, plans)
    for k in range(SIZE * SIZE):
        plans.costs[row, 1, k] = plans.costs[row, 0, k]


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


@wp.func
def least_cost(row: int, before: State, speed: float, ahead: Steps, aside: Steps, body: Body, plans: Plans):
    """Cost of a drive whose second part has a speed, without what is around it: at most that of the drive itself.

    ``ahead`` and ``aside`` are cosines and sines of its headings.
    """
    x = before[0]
    y = before[1]
    v = before[3]
    cost = before[5]
    goal = plans.goals[row]
    number = int(0)
    while number < SECOND:
        v = approach(v, speed, body.acceleration * DRIVE_DT)
        x += v * DRIVE_DT * ahead[number]
        y += v * DRIVE_DT * aside[number]
        cost += DRIVE_DT * wp.where(speed < 0.0, 1.0 + BACKWARD_COST, 1.0)
        number += 1
        if wp.length(goal - wp.vec2(x, y)) < plans.goal_radius:
            return cost
    return cost + cost_at(plans, row, x, y)


@wp.func
def cost_of(
    row: int, before: State, speed: float, yaw_rate: float, most: float, body: Body, around: Around, plans: Plans
):
    """Cost of a drive with a second part, or any that is larger than ``most`` if it is."""
    goal = plans.goals[row]
    next = before
    number = int(FIRST)
    while number < FIRST + SECOND:
        number += 1
        next = drive_step(row, number, next, speed, yaw_rate, body, around)
        if next[5] > most or wp.length(goal - wp.vec2(next[0], next[1])) < plans.goal_radius:
            return next[5]
    return next[5] + cost_at(plans, row, next[0], next[1])


@wp.kernel
def drive(
    states: wp.array2d[float],
    body: Body,
    around: Around,
    plans: Plans,
    bests: wp.array[float],
    results: wp.array2d[float],
):
    """Least cost of the drives that begin with a speed and a yaw rate; a thread does one pair of a row.

    ``states`` are x, y, heading, speed and yaw rate of each row, ``around`` has the movers at the steps of a drive, and
    ``results`` are the least costs, s, ``[N, SPEEDS * TURNS]``. Drives that cannot be the best of a row, whose least
    cost until now is in ``bests``, are left out: the others begin with larger costs.
    """
    row, last = wp.tid()
    # From full speed ahead on, as that is most often the best.
    pair = SPEEDS * TURNS - 1 - last
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
            wp.atomic_min(bests, row, state[5])
            return
    best = float(3.0 * CRASH)
    ahead = Steps()
    aside = Steps()
    turn = int(0)
    while turn < SECOND_TURNS:
        yaw_rate2 = body.yaw_rate * (2.0 * float(turn) / float(SECOND_TURNS - 1) - 1.0)
        w = state[4]
        heading = state[2]
        number = int(0)
        while number < SECOND:
            w = approach(w, yaw_rate2, body.yaw_acceleration * DRIVE_DT)
            ahead[number] = wp.cos(heading + 0.5 * w * DRIVE_DT)
            aside[number] = wp.sin(heading + 0.5 * w * DRIVE_DT)
            heading += w * DRIVE_DT
            number += 1
        turn += 1
        second = int(SPEEDS)
        while second > 0:
            second -= 1
            speed2 = body.speed * (float(second) / half - 1.0)
            if wp.abs(yaw_rate2) * body.turning <= wp.abs(speed2) + 1.0e-6:
                if least_cost(row, state, speed2, ahead, aside, body, plans) < bests[row] + ROUNDING:
                    cost = cost_of(row, state, speed2, yaw_rate2, bests[row], body, around, plans)
                    best = wp.min(best, cost)
                    wp.atomic_min(bests, row, cost)
    results[row, pair] = best
