"""Warp kernel of the step of movers that walk: straight on, by social forces, or by reciprocal collision avoidance.

The social forces are those of Helbing and Molnar (1995). The linear programs of collision avoidance (ORCA) are those of
van den Berg et al. (2011) and of RVO2 (https://gamma.cs.unc.edu/RVO2). A line ``(x, y, dx, dy)`` allows the velocities
on the left of the point ``(x, y)`` (m/s) in the direction ``(dx, dy)``, a unit vector.
"""

from __future__ import annotations

from rover_rl.native.warp import wp
from rover_rl.worlds.movers import walking_kernels as walking
from rover_rl.worlds.movers.walking_kernels import DRAWS, FAR, SPEED, START, TWO_PI, Crowd, States, uniform, wall_at

# Settings of a mover, by index, in the order of the fields of `SocialForce`, and of `Orca`.
SEES_ROVER, RELAXATION, STRENGTH, REACH, WALL_STRENGTH, WALL_REACH, BEHIND, FORESIGHT, FLUCTUATION = (
    wp.constant(walking.OWN + k) for k in range(9)
)
HORIZON, ORCA_SEES_ROVER, MARGIN = (wp.constant(walking.OWN + k) for k in range(3))

# Of social forces: radius of the people who are points in the paper, m; cosine of half the angle of sight, 100 degrees;
# largest speed, in desired ones; largest way by which movers that overlap are pushed apart in a step, m; and distance
# without a force, in ranges of the potential: exp(-10) is 5e-5.
PAPER_RADIUS, COS_VIEW, MAX_FACTOR, MAX_PUSH, CUT_OFF = map(wp.constant, (0.2, -0.1736482, 1.3, 0.1, 10.0))
ROOT_3 = wp.constant(1.7320508)

# Of ORCA: numbers of nearest movers (as in the examples of RVO2) and of rovers that it avoids; of lines: two walls,
# rovers and movers; time within which it keeps off walls, s; and random part of the desired velocity, in speeds,
# without which two that meet head-on both stop.
NEIGHBORS, MAX_ROVERS, MAX_LINES = wp.constant(10), wp.constant(4), 16
WALL_TIME, NOISE, TINY = map(wp.constant, (0.5, 0.02, 1.0e-5))

# Largest slope of distances to walls, which are interpolated: more than the root of 2.
STEEPEST = wp.constant(1.5)

Lines = wp.types.matrix(shape=(MAX_LINES, 4), dtype=float)
Indices = wp.types.vector(length=NEIGHBORS, dtype=int)
Distances = wp.types.vector(length=NEIGHBORS, dtype=float)


@wp.func
def repulsion(offset: wp.vec2, stride: wp.vec2, excess: float, strength: float, reach: float) -> wp.vec2:
    """Acceleration by another mover, ``offset`` away: minus the gradient of ``strength exp(-b / reach)``, m/s^2.

    ``b`` is the minor half-axis of the ellipse through the mover whose foci are where the other one is now and after
    its next step, ``stride`` (m). The two are by ``excess`` (m) larger than in the paper.
    """
    if wp.length(offset) > CUT_OFF * reach + excess + wp.length(stride):
        return wp.vec2(0.0, 0.0)
    ahead = offset - stride
    near = wp.max(wp.length(offset), 1.0e-4)
    far = wp.max(wp.length(ahead), 1.0e-4)
    both = near + far
    b = 0.5 * wp.sqrt(wp.max(both * both - wp.length_sq(stride), 1.0e-6))
    slope = both / (4.0 * b) * (offset / near + ahead / far)
    return strength / reach * wp.exp(-wp.max(b - excess, 0.0) / reach) * slope


@wp.func
def weight(force: wp.vec2, direction: wp.vec2, behind: float) -> float:
    """Weight of a force of something in sight of the desired direction, or behind."""
    return wp.where(-wp.dot(force, direction) >= COS_VIEW * wp.length(force), 1.0, behind)


@wp.func
def push_apart(offset: wp.vec2, least: float, share: float) -> wp.vec2:
    """Way of a mover that overlaps with another one, whose centers must be ``least`` apart."""
    square = wp.length_sq(offset)
    if square >= least * least:
        return wp.vec2(0.0, 0.0)
    distance = wp.max(wp.sqrt(square), 1.0e-4)
    return (least - distance) * share * offset / distance


@wp.func
def acceleration(crowd: Crowd, before: States, row: int, mover: int, way: wp.vec2) -> wp.vec2:
    """Sum of the forces on a mover whose desired direction is ``way``, m/s^2."""
    point = before.position[row, mover]
    radius = crowd.radius[row, mover]
    strength = crowd.settings[row, mover, STRENGTH]
    reach = crowd.settings[row, mover, REACH]
    behind = crowd.settings[row, mover, BEHIND]
    foresight = crowd.settings[row, mover, FORESIGHT]
    desired = crowd.settings[row, mover, SPEED] * way
    sum = (desired - before.velocity[row, mover]) / crowd.settings[row, mover, RELAXATION]
    for other in range(crowd.present.shape[1]):
        if crowd.present[row, other] and other != mover:
            excess = radius + crowd.radius[row, other] - 2.0 * PAPER_RADIUS
            stride = foresight * before.velocity[row, other]
            force = repulsion(point - before.position[row, other], stride, excess, strength, reach)
            sum += weight(force, way, behind) * force
    if crowd.settings[row, mover, SEES_ROVER] > 0.0:
        for rover in range(crowd.rovers.shape[1]):
            excess = radius + crowd.rover_radius - 2.0 * PAPER_RADIUS
            stride = foresight * crowd.rover_velocities[row, rover]
            force = repulsion(point - crowd.rovers[row, rover], stride, excess, strength, reach)
            sum += weight(force, way, behind) * force
    wall = wall_at(crowd, row, point)
    wall_reach = crowd.settings[row, mover, WALL_REACH]
    gap = wp.max(wall[0] - radius + PAPER_RADIUS, 0.0)
    push = crowd.settings[row, mover, WALL_STRENGTH] / wall_reach * wp.exp(-gap / wall_reach)
    return sum + push * wp.vec2(wall[1], wall[2])


@wp.func
def way_by_forces(crowd: Crowd, before: States, row: int, mover: int, way: wp.vec2) -> wp.vec2:
    """Way of a mover in a step of the social force model."""
    dt = crowd.dt
    start = before.position[row, mover]
    # Uniform numbers of the standard deviation that is set.
    noise = walking.step_noise(crowd, row, mover)
    sum = acceleration(crowd, before, row, mover, way)
    sum += crowd.settings[row, mover, FLUCTUATION] * 2.0 * ROOT_3 * noise
    velocity = before.velocity[row, mover] + dt * sum
    most = MAX_FACTOR * crowd.settings[row, mover, SPEED]
    velocity = velocity * wp.min(1.0, most / wp.max(wp.length(velocity), 1.0e-6))
    # Contact, where the others will be if they go on.
    next = start + dt * velocity
    push = wp.vec2(0.0, 0.0)
    radius = crowd.radius[row, mover]
    for other in range(crowd.present.shape[1]):
        if crowd.present[row, other] and other != mover:
            offset = next - before.position[row, other] - dt * before.velocity[row, other]
            push += push_apart(offset, radius + crowd.radius[row, other], wp.where(crowd.mine[row, other], 0.5, 1.0))
    if crowd.settings[row, mover, SEES_ROVER] > 0.0:
        for rover in range(crowd.rovers.shape[1]):
            offset = next - crowd.rovers[row, rover] - dt * crowd.rover_velocities[row, rover]
            push += push_apart(offset, radius + crowd.rover_radius, 1.0)
    push = push * wp.min(1.0, MAX_PUSH / wp.max(wp.length(push), 1.0e-6))
    return next - start + push


@wp.func
def det(a: wp.vec2, b: wp.vec2) -> float:
    return a[0] * b[1] - a[1] * b[0]


@wp.func
def solve_on_line(lines: Lines, number: int, most: float, wanted: wp.vec2, along: bool) -> wp.vec3:
    """Best velocity on a line that the lines before it allow, and whether there is one (1 or 0).

    The best one is next to ``wanted``, or the farthest in the direction ``wanted`` if ``along``.
    """
    point = wp.vec2(lines[number, 0], lines[number, 1])
    direction = wp.vec2(lines[number, 2], lines[number, 3])
    middle = wp.dot(point, direction)
    under = middle * middle + most * most - wp.length_sq(point)
    if under < 0.0:
        return wp.vec3(0.0, 0.0, 0.0)
    low = -middle - wp.sqrt(under)
    high = -middle + wp.sqrt(under)
    for k in range(number):
        other = wp.vec2(lines[k, 2], lines[k, 3])
        denominator = det(direction, other)
        numerator = det(other, point - wp.vec2(lines[k, 0], lines[k, 1]))
        if wp.abs(denominator) <= TINY:
            if numerator < 0.0:
                return wp.vec3(0.0, 0.0, 0.0)
        else:
            t = numerator / denominator
            high = wp.where(denominator >= 0.0, wp.min(high, t), high)
            low = wp.where(denominator >= 0.0, low, wp.max(low, t))
            if low > high:
                return wp.vec3(0.0, 0.0, 0.0)
    best = wp.clamp(wp.dot(direction, wanted - point), low, high)
    if along:
        best = wp.where(wp.dot(wanted, direction) > 0.0, high, low)
    velocity = point + best * direction
    return wp.vec3(velocity[0], velocity[1], 1.0)


@wp.func
def solve(lines: Lines, count: int, most: float, wanted: wp.vec2, along: bool) -> wp.vec3:
    """Best velocity that all lines allow, and the number of the line where none was left, or ``count``."""
    velocity = most * wanted
    if not along:
        velocity = wanted * wp.min(1.0, most / wp.max(wp.length(wanted), 1.0e-6))
    for number in range(count):
        point = wp.vec2(lines[number, 0], lines[number, 1])
        if det(wp.vec2(lines[number, 2], lines[number, 3]), point - velocity) > 0.0:
            found = solve_on_line(lines, number, most, wanted, along)
            if found[2] == 0.0:
                return wp.vec3(velocity[0], velocity[1], float(number))
            velocity = wp.vec2(found[0], found[1])
    return wp.vec3(velocity[0], velocity[1], float(count))


@wp.func
def solve_least_bad(
    lines: Lines, walls_count: int, count: int, first: int, most: float, velocity_before: wp.vec2
) -> wp.vec2:
    """Velocity where no line allows any: it breaks those of walls not at all, and those of others least."""
    velocity = velocity_before
    depth = float(0.0)
    for number in range(first, count):
        point = wp.vec2(lines[number, 0], lines[number, 1])
        direction = wp.vec2(lines[number, 2], lines[number, 3])
        if det(direction, point - velocity) > depth:
            projected = Lines()
            for k in range(walls_count):
                projected[k] = lines[k]
            used = int(walls_count)
            for k in range(walls_count, number):
                other_point = wp.vec2(lines[k, 0], lines[k, 1])
                other = wp.vec2(lines[k, 2], lines[k, 3])
                across = det(direction, other)
                at = 0.5 * (point + other_point)
                adds = bool(True)
                if wp.abs(across) <= TINY:
                    # Parallel lines in the same direction: the other one has no part.
                    adds = wp.dot(direction, other) <= 0.0
                else:
                    at = point + det(other, point - other_point) / across * direction
                if adds:
                    between = wp.normalize(other - direction)
                    projected[used] = wp.vec4(at[0], at[1], between[0], between[1])
                    used += 1
            found = solve(projected, used, most, walking.left_of(direction), True)
            if int(found[2]) == used:
                velocity = wp.vec2(found[0], found[1])
            depth = det(direction, point - velocity)
    return velocity


@wp.func
def line_of(
    offset: wp.vec2, velocity: wp.vec2, relative: wp.vec2, radius: float, horizon: float, dt: float, share: float
) -> wp.vec4:
    """Line of the velocities with which a mover avoids another one, at ``offset`` and with ``radius``, the sum of both.

    They must not collide within ``horizon``, and no longer overlap after ``dt`` if they do, s. ``relative`` is the
    velocity relative to the other one, and ``share`` that of the evasion that this one does.
    """
    square = wp.length_sq(offset)
    change = wp.vec2(0.0, 0.0)
    direction = wp.vec2(1.0, 0.0)
    time = wp.where(square > radius * radius, horizon, dt)
    beside = relative - offset / time
    inward = wp.dot(beside, offset)
    if square <= radius * radius or (inward < 0.0 and inward * inward > radius * radius * wp.length_sq(beside)):
        # The disc at the end of the velocity obstacle.
        length = wp.max(wp.length(beside), 1.0e-6)
        normal = beside / length
        direction = wp.vec2(normal[1], -normal[0])
        change = (radius / time - length) * normal
    else:
        leg = wp.sqrt(square - radius * radius)
        if det(offset, beside) > 0.0:
            direction = wp.vec2(offset[0] * leg - offset[1] * radius, offset[0] * radius + offset[1] * leg) / square
        else:
            direction = -wp.vec2(offset[0] * leg + offset[1] * radius, -offset[0] * radius + offset[1] * leg) / square
        change = wp.dot(relative, direction) * direction - relative
    point = velocity + share * change
    return wp.vec4(point[0], point[1], direction[0], direction[1])


@wp.func
def wall_line(crowd: Crowd, row: int, start: wp.vec2, probe: wp.vec2, kept: float) -> wp.vec4:
    """Line of the velocities with which a mover keeps off the wall that is next to ``probe``."""
    wall = wall_at(crowd, row, probe)
    away = wp.vec2(wall[1], wall[2])
    gap = wp.max(wall[0] - kept + wp.dot(start - probe, away), 0.0)
    if wp.length_sq(away) == 0.0:
        return wp.vec4(FAR, 0.0, 0.0, 0.0)
    return wp.vec4(-gap / WALL_TIME * away[0], -gap / WALL_TIME * away[1], away[1], -away[0])


@wp.func
def nearest_movers(crowd: Crowd, before: States, row: int, mover: int) -> Indices:
    """Indices of the nearest movers that it could meet within the horizon, -1 for none, by ascending distance."""
    indices = Indices()
    squares = Distances()
    for k in range(NEIGHBORS):
        indices[k] = -1
        squares[k] = FAR
    point = before.position[row, mover]
    horizon = crowd.settings[row, mover, HORIZON]
    own = crowd.radius[row, mover] + crowd.settings[row, mover, MARGIN] + horizon * crowd.settings[row, mover, SPEED]
    for other in range(crowd.present.shape[1]):
        if crowd.present[row, other] and other != mover:
            square = wp.length_sq(before.position[row, other] - point)
            reach = own + crowd.radius[row, other] + horizon * wp.length(before.velocity[row, other])
            if square < reach * reach and square < squares[NEIGHBORS - 1]:
                k = int(NEIGHBORS - 1)
                while k > 0 and squares[wp.max(k - 1, 0)] > square:
                    squares[k] = squares[k - 1]
                    indices[k] = indices[k - 1]
                    k -= 1
                squares[k] = square
                indices[k] = other
    return indices


@wp.func
def way_that_avoids(crowd: Crowd, before: States, row: int, mover: int, way: wp.vec2) -> wp.vec2:
    """Way of a mover in a step of reciprocal collision avoidance."""
    dt = crowd.dt
    start = before.position[row, mover]
    speed = crowd.settings[row, mover, SPEED]
    velocity = before.velocity[row, mover]
    noise = walking.step_noise(crowd, row, mover)
    wanted = wp.min(speed, wp.length(before.goal[row, mover] - start) / dt) * way + NOISE * speed * noise
    radius = crowd.radius[row, mover]
    kept = walking.kept_distance(crowd, row, radius)
    lines = Lines()
    count = int(0)
    for probe in range(2):
        line = wall_line(crowd, row, start, start + WALL_TIME * float(probe) * wanted, kept)
        if line[0] != FAR:
            lines[count] = line
            count += 1
    walls_count = count
    reach = radius + crowd.settings[row, mover, MARGIN]
    horizon = crowd.settings[row, mover, HORIZON]
    if crowd.settings[row, mover, ORCA_SEES_ROVER] > 0.0:
        for rover in range(wp.min(crowd.rovers.shape[1], MAX_ROVERS)):
            relative = velocity - crowd.rover_velocities[row, rover]
            offset = crowd.rovers[row, rover] - start
            lines[count] = line_of(offset, velocity, relative, reach + crowd.rover_radius, horizon, dt, 1.0)
            count += 1
    others = nearest_movers(crowd, before, row, mover)
    for number in range(NEIGHBORS):
        other = others[number]
        if other >= 0:
            share = wp.where(crowd.mine[row, other] and before.clock[row, other] >= 0.0, 0.5, 1.0)
            relative = velocity - before.velocity[row, other]
            offset = before.position[row, other] - start
            lines[count] = line_of(offset, velocity, relative, reach + crowd.radius[row, other], horizon, dt, share)
            count += 1
    found = solve(lines, count, speed, wanted, False)
    taken = wp.vec2(found[0], found[1])
    if int(found[2]) < count:
        taken = solve_least_bad(lines, walls_count, count, int(found[2]), speed, taken)
    return dt * taken


@wp.func
def edge_at(crowd: Crowd, row: int, mover: int, point: wp.vec2) -> wp.vec3:
    """Distance to the edge of the area of a mover (m), negative outside, and direction away from it."""
    if crowd.settings[row, mover, START] == 0.0:
        return wp.vec3(FAR, 0.0, 0.0)
    limits = walking.limits_of(crowd, row, mover, START)
    west = point[0] - limits[0]
    east = limits[1] - point[0]
    south = point[1] - limits[2]
    north = limits[3] - point[1]
    least = wp.min(wp.min(west, east), wp.min(south, north))
    if least == west:
        return wp.vec3(west, 1.0, 0.0)
    if least == east:
        return wp.vec3(east, -1.0, 0.0)
    if least == south:
        return wp.vec3(south, 0.0, 1.0)
    return wp.vec3(north, 0.0, -1.0)


@wp.func
def wander(crowd: Crowd, before: States, after: States, row: int, mover: int):
    """Moves a wanderer by one step."""
    dt = crowd.dt
    speed = crowd.settings[row, mover, SPEED]
    start = before.position[row, mover]
    direction = before.goal[row, mover]
    draws = before.draws[row, mover]
    clock = before.clock[row, mover] - dt
    if clock <= 0.0:
        key = crowd.keys[row, mover]
        direction = walking.heading_of(TWO_PI * uniform(key, DRAWS, wp.uint64(draws), 0))
        clock += walking.exponential(crowd.settings[row, mover, walking.OWN], uniform(key, DRAWS, wp.uint64(draws), 1))
        draws = draws + wp.int64(1)
    kept = walking.kept_distance(crowd, row, crowd.radius[row, mover])
    ahead = start + speed * dt * direction
    point = ahead
    edge = edge_at(crowd, row, mover, ahead)
    room = before.room[row, mover] - STEEPEST * speed * dt
    # In the open, looking up the distance to walls would take most of the time.
    if room < 0.0 or edge[0] < 0.0 or walking.pieces_of(speed * dt * direction, kept) > 1:
        wall = wall_at(crowd, row, ahead)
        room = wall[0] - kept - walking.SLACK
        if edge[0] < wall[0] - kept:
            wall = wp.vec3(edge[0] + kept, edge[1], edge[2])
        away = wp.vec2(wall[1], wall[2])
        if wall[0] < kept:
            direction = direction - 2.0 * wp.min(wp.dot(direction, away), 0.0) * away
        point = walking.walked(crowd, row, start, speed * dt * direction, kept)
        if crowd.settings[row, mover, START] > 0.0:
            limits = walking.limits_of(crowd, row, mover, START)
            point = wp.vec2(wp.clamp(point[0], limits[0], limits[1]), wp.clamp(point[1], limits[2], limits[3]))
            if wall_at(crowd, row, point)[0] < kept - walking.SLACK:
                point = start
        if wp.length_sq(point - ahead) > 0.0:
            room = 0.0
    # In a corner, it turns back.
    if wp.length(point - start) < 0.25 * speed * dt:
        direction = -direction
    after.position[row, mover] = point
    after.velocity[row, mover] = (point - start) / dt
    after.yaw[row, mover] = walking.turned(before.yaw[row, mover], direction, dt)
    after.goal[row, mover] = direction
    after.clock[row, mover] = clock
    after.draws[row, mover] = draws
    after.room[row, mover] = room


@wp.kernel
def begin(crowd: Crowd, law: int, after: States, first: int):
    """Begins the episodes of movers, in ascending order; thread ``row``. A wanderer's goal is its direction."""
    row = first + wp.tid()
    for mover in range(crowd.mine.shape[1]):
        if crowd.mine[row, mover]:
            point = walking.draw_start(crowd, after, row, mover)
            after.position[row, mover] = point
            if law == walking.WANDER:
                key = crowd.keys[row, mover]
                yaw = TWO_PI * (uniform(key, DRAWS, wp.uint64(0), 2 * walking.CANDIDATES) - 0.5)
                number = uniform(key, DRAWS, wp.uint64(0), 2 * walking.CANDIDATES + 1)
                after.velocity[row, mover] = crowd.settings[row, mover, SPEED] * walking.heading_of(yaw)
                after.goal[row, mover] = walking.heading_of(yaw)
                after.yaw[row, mover] = yaw
                after.clock[row, mover] = walking.exponential(crowd.settings[row, mover, walking.OWN], number)
                after.draws[row, mover] = wp.int64(1)
            else:
                goal = walking.draw_goal(crowd, row, mover, point, wp.int64(1))
                after.velocity[row, mover] = wp.vec2(0.0, 0.0)
                after.goal[row, mover] = goal
                after.yaw[row, mover] = wp.atan2(goal[1] - point[1], goal[0] - point[0])
                after.clock[row, mover] = crowd.settings[row, mover, walking.PATIENCE]
                after.draws[row, mover] = wp.int64(2)


@wp.kernel
def step(crowd: Crowd, law: int, before: States, after: States, first: int):
    """Moves movers by one step of the law of a motion, ``Walk.law``; thread ``(row, mover)``."""
    t, mover = wp.tid()
    row = first + t
    if not crowd.mine[row, mover]:
        return
    if law == walking.WANDER:
        wander(crowd, before, after, row, mover)
        return
    start = before.position[row, mover]
    point = start
    clock = before.clock[row, mover]
    if clock >= 0.0:
        goal = before.goal[row, mover]
        way = walking.way_to(crowd, row, mover, start, goal, before.draws[row, mover])
        move = wp.min(crowd.settings[row, mover, SPEED] * crowd.dt, wp.length(goal - start)) * way
        if law == walking.SOCIAL_FORCE:
            move = way_by_forces(crowd, before, row, mover, way)
        if law == walking.ORCA:
            move = way_that_avoids(crowd, before, row, mover, way)
        point = walking.walked(crowd, row, start, move, walking.kept_distance(crowd, row, crowd.radius[row, mover]))
    walking.finish_step(crowd, before, after, row, mover, point, clock)
