"""Warp kernel of the step of movers that walk: straight on, by social forces, or by reciprocal collision avoidance.

The social forces are those of Helbing and Molnar (1995). The linear programs of collision avoidance (ORCA) are those of
van den Berg et al. (2011) and of RVO2 (https://gamma.cs.unc.edu/RVO2). A line ``(x, y, dx, dy)`` allows the velocities
on the left of the point ``(x, y)`` (m/s) in the direction ``(dx, dy)``, a unit vector.
"""

from __future__ import annotations

from rover_rl.native.warp import wp
from rover_rl.worlds.movers.walking_kernels import (
    FAR,
    ORCA,
    OWN,
    SOCIAL_FORCE,
    SPEED,
    WANDER,
    Crowd,
    States,
    finish_step,
    kept_distance,
    left_of,
    step_noise,
    walked,
    wall_at,
    wander,
    way_to,
)

# Settings of a mover, by index, in the order of the fields of `SocialForce`, and of `Orca`.
SEES_ROVER, RELAXATION, STRENGTH, REACH, WALL_STRENGTH, WALL_REACH, BEHIND, FORESIGHT, FLUCTUATION = (
    wp.constant(OWN + k) for k in range(9)
)
HORIZON, ORCA_SEES_ROVER, MARGIN = (wp.constant(OWN + k) for k in range(3))

PAPER_RADIUS = wp.constant(0.2)
"""Radius of the people who are points in the paper on social forces, m."""
COS_VIEW = wp.constant(-0.1736482)
"""Cosine of 100 degrees, half the angle of sight."""
MAX_FACTOR = wp.constant(1.3)
"""Largest speed, in desired speeds."""
MAX_PUSH = wp.constant(0.1)
"""Largest way by which movers that overlap are pushed apart in a step, m."""
CUT_OFF = wp.constant(10.0)
"""Distance without a force, in ranges of the potential: exp(-10) is 5e-5."""
ROOT_3 = wp.constant(1.7320508)

NEIGHBORS = wp.constant(10)
"""Number of nearest movers that ORCA avoids, as in the examples of RVO2."""
MAX_ROVERS = wp.constant(4)
"""Number of rovers that it avoids."""
MAX_LINES = 16
"""Number of lines for which there is space: two walls, rovers and movers."""
WALL_TIME = wp.constant(0.5)
"""Time within which it keeps off walls, s."""
NOISE = wp.constant(0.02)
"""Random part of the desired velocity, in speeds, without which two that meet head-on both stop."""
TINY = wp.constant(1.0e-5)

Lines = wp.types.matrix(shape=(MAX_LINES, 4), dtype=float)
Indices = wp.types.vector(length=NEIGHBORS, dtype=int)
Distances = wp.types.vector(length=NEIGHBORS, dtype=float)


@wp.func
def repulsion(offset: wp.vec2, stride: wp.vec2, excess: float, strength: float, reach: float) -> wp.vec2:
    """Acceleration by another mover: minus the gradient of ``strength exp(-b / reach)``, m/s^2.

    ``b`` is the minor half-axis of the ellipse through the mover whose foci are where the other one is now and after
    its next step, ``stride`` (m). ``offset`` (m) is from the other mover to this one, and ``excess`` (m) by how much
    the two are larger than in the paper.
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
            stride = foresight * before.velocity[row, other]
            excess = radius + crowd.radius[row, other] - 2.0 * PAPER_RADIUS
            force = repulsion(point - before.position[row, other], stride, excess, strength, reach)
            sum += weight(force, way, behind) * force
    if crowd.settings[row, mover, SEES_ROVER] > 0.0:
        for k in range(crowd.rovers.shape[1]):
            stride = foresight * crowd.rover_velocities[row, k]
            excess = radius + crowd.rover_radius - 2.0 * PAPER_RADIUS
            force = repulsion(point - crowd.rovers[row, k], stride, excess, strength, reach)
            sum += weight(force, way, behind) * force
    wall = wall_at(crowd, row, point)
    wall_reach = crowd.settings[row, mover, WALL_REACH]
    gap = wp.max(wall[0] - radius + PAPER_RADIUS, 0.0)
    sum += (
        crowd.settings[row, mover, WALL_STRENGTH] / wall_reach * wp.exp(-gap / wall_reach) * wp.vec2(wall[1], wall[2])
    )
    return sum


@wp.func
def way_by_forces(crowd: Crowd, before: States, row: int, mover: int, way: wp.vec2) -> wp.vec2:
    """Way of a mover in a step of the social force model."""
    dt = crowd.dt
    start = before.position[row, mover]
    # Uniform numbers of the standard deviation that is set.
    noise = step_noise(crowd, row, mover)
    sum = acceleration(crowd, before, row, mover, way)
    sum += crowd.settings[row, mover, FLUCTUATION] * 2.0 * ROOT_3 * noise
    velocity = before.velocity[row, mover] + dt * sum
    most = MAX_FACTOR * crowd.settings[row, mover, SPEED]
    velocity = velocity * wp.min(1.0, most / wp.max(wp.length(velocity), 1.0e-6))
    # Contact, where the others will be if they go on.
    next = start + dt * velocity
    radius = crowd.radius[row, mover]
    push = wp.vec2(0.0, 0.0)
    for other in range(crowd.present.shape[1]):
        if crowd.present[row, other] and other != mover:
            share = wp.where(crowd.mine[row, other], 0.5, 1.0)
            offset = next - before.position[row, other] - dt * before.velocity[row, other]
            push += push_apart(offset, radius + crowd.radius[row, other], share)
    if crowd.settings[row, mover, SEES_ROVER] > 0.0:
        for k in range(crowd.rovers.shape[1]):
            offset = next - crowd.rovers[row, k] - dt * crowd.rover_velocities[row, k]
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
            if denominator >= 0.0:
                high = wp.min(high, t)
            else:
                low = wp.max(low, t)
            if low > high:
                return wp.vec3(0.0, 0.0, 0.0)
    if along:
        best = wp.where(wp.dot(wanted, direction) > 0.0, high, low)
    else:
        best = wp.clamp(wp.dot(direction, wanted - point), low, high)
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
            used = int(0)
            for k in range(walls_count):
                projected[used] = lines[k]
                used += 1
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
            found = solve(projected, used, most, left_of(direction), True)
            if int(found[2]) == used:
                velocity = wp.vec2(found[0], found[1])
            depth = det(direction, point - velocity)
    return velocity


@wp.func
def line_of(
    offset: wp.vec2, velocity: wp.vec2, relative: wp.vec2, radius: float, horizon: float, dt: float, share: float
) -> wp.vec4:
    """Line of the velocities with which a mover avoids another one.

    Args:
        offset: position of the other one relative to this one, m.
        velocity: velocity of this one, m/s.
        relative: velocity relative to the other one, m/s.
        radius: sum of the radii, m.
        horizon: time within which they must not collide, s.
        dt: duration of a step, within which they must no longer overlap if they do, s.
        share: share of the evasion that this one does.
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
    noise = step_noise(crowd, row, mover)
    wanted = wp.min(speed, wp.length(before.goal[row, mover] - start) / dt) * way + NOISE * speed * noise
    radius = crowd.radius[row, mover]
    kept = kept_distance(crowd, row, radius)
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


@wp.kernel
def step(crowd: Crowd, law: int, before: States, after: States):
    """Moves movers by one step of the law of a motion, ``Walk.law``; thread ``(row, mover)``."""
    row, mover = wp.tid()
    if not crowd.mine[row, mover]:
        return
    if law == WANDER:
        wander(crowd, before, after, row, mover)
        return
    start = before.position[row, mover]
    point = start
    clock = before.clock[row, mover]
    if clock >= 0.0:
        goal = before.goal[row, mover]
        way = way_to(crowd, row, mover, start, goal, before.draws[row, mover])
        move = wp.min(crowd.settings[row, mover, SPEED] * crowd.dt, wp.length(goal - start)) * way
        if law == SOCIAL_FORCE:
            move = way_by_forces(crowd, before, row, mover, way)
        if law == ORCA:
            move = way_that_avoids(crowd, before, row, mover, way)
        point = walked(crowd, row, start, move, kept_distance(crowd, row, crowd.radius[row, mover]))
    finish_step(crowd, before, after, row, mover, point, clock)
