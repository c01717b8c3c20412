"""Warp kernels and functions of the movers that walk: random numbers, walls, starts and goals.

A thread moves one mover, or begins the episodes of all movers of a row. Nothing depends on other rows.
"""

from __future__ import annotations

from dataclasses import fields
from typing import Any

from rover_rl.native.warp import wp
from rover_rl.worlds.movers.motion import MotionInput, MoverState

# Settings of a mover, by index: see `Walk.tensors`.
# From OWN on, there are those that not all motions have.
SPEED, START, GOAL, PAUSE, PATIENCE, OWN = map(wp.constant, (0, 1, 6, 11, 12, 13))

# Number of points that are tried for a start or a goal; distance at which a goal is reached, m; largest rate at which a
# mover turns to where it walks, rad/s; least distance between the surfaces of mover and rover at the start, m.
CANDIDATES, ARRIVED, TURN_RATE, FREE_OF_ROVER = map(wp.constant, (64, 0.2, 3.1415927, 1.5))
# Distance from a wall within which a mover walks along it rather than toward it, and depth by which it may be too close
# to a wall, m.
BAND, SLACK = map(wp.constant, (0.4, 0.005))
TWO_PI, FAR = map(wp.constant, (6.2831853, 1.0e9))
LAWS = ("cross", "social_force", "orca", "wander")
_CROSS, SOCIAL_FORCE, ORCA, WANDER = (wp.constant(k) for k in range(len(LAWS)))
# Streams of random numbers: of draws, and of what is drawn in each step. Constants are those of rover_rl.rng.
DRAWS, STEPS = wp.constant(wp.uint64(33)), wp.constant(wp.uint64(34))
_GOLDEN, _MIX_1 = wp.constant(wp.uint64(0x9E3779B97F4A7C15)), wp.constant(wp.uint64(0xBF58476D1CE4E5B9))
_MIX_2, _STREAM = wp.constant(wp.uint64(0x94D049BB133111EB)), wp.constant(wp.uint64(0xDA942042E4DD58B5))
_DRAW, _MASK = wp.constant(wp.uint64(0xAEF17502108EF2D9)), wp.constant(wp.uint64(0xFFFFFF))
_UNIT = wp.constant(5.9604645e-8)


@wp.struct
class Crowd:
    """What the walk of each mover depends on: see :class:`~rover_rl.worlds.movers.MotionInput`."""

    mine: wp.array2d[wp.bool]
    present: wp.array2d[wp.bool]
    radius: wp.array2d[float]
    settings: wp.array3d[float]
    keys: wp.array2d[wp.uint64]
    arena: wp.array2d[float]
    rovers: wp.array2d[wp.vec2]
    rover_velocities: wp.array2d[wp.vec2]
    rover_radius: float
    time: wp.array2d[wp.float64]
    dt: float
    # Distances to walls: see WallDistances.
    distances: wp.array2d[float]
    grids: wp.array2d[float]
    slots: wp.array[wp.int64]


@wp.struct
class States:
    """State of all movers: see :class:`~rover_rl.worlds.movers.MoverState`."""

    position: wp.array2d[wp.vec2]
    yaw: wp.array2d[float]
    velocity: wp.array2d[wp.vec2]
    goal: wp.array2d[wp.vec2]
    clock: wp.array2d[float]
    draws: wp.array2d[wp.int64]
    room: wp.array2d[float]


def crowd_of(inputs: MotionInput) -> Any:
    """Returns what a kernel reads, in the same memory where possible."""
    crowd, rovers = Crowd(), inputs.rovers
    crowd.mine, crowd.present = (wp.from_torch(mask.contiguous()) for mask in (inputs.mine, inputs.present))
    crowd.radius, crowd.arena = (wp.from_torch(part.float().contiguous()) for part in (inputs.radius, inputs.arena))
    crowd.settings = wp.from_torch(inputs.settings["walk"].contiguous())
    crowd.keys = wp.from_torch(inputs.keys.contiguous(), dtype=wp.uint64)
    crowd.rovers, crowd.rover_velocities = (
        wp.from_torch(part.float().contiguous(), dtype=wp.vec2) for part in (rovers.position, rovers.velocity)
    )
    crowd.rover_radius, crowd.dt, crowd.time = rovers.radius, inputs.dt, wp.from_torch(inputs.time)
    crowd.distances, crowd.grids, crowd.slots = (wp.from_torch(part.contiguous()) for part in inputs.walls)
    return crowd


def arrays_of(state: MoverState) -> Any:
    """Returns a state as a kernel reads and writes it, in the same memory."""
    states = States()
    for item in fields(MoverState):
        value = getattr(state, item.name)
        setattr(states, item.name, wp.from_torch(value, dtype=wp.vec2) if value.ndim == 3 else wp.from_torch(value))
    return states


@wp.func
def mixed(bits: wp.uint64) -> wp.uint64:
    """Finalizer of SplitMix64."""
    x = (bits ^ (bits >> wp.uint64(30))) * _MIX_1
    x = (x ^ (x >> wp.uint64(27))) * _MIX_2
    return x ^ (x >> wp.uint64(31))


@wp.func
def uniform(key: wp.uint64, stream: wp.uint64, draw: wp.uint64, lane: int) -> float:
    """Uniform number in [0, 1): the one of ``to_unit(random_bits(key, stream, draw, lane + 1)[..., lane])``."""
    bits = mixed(key + draw * _DRAW + stream * _STREAM + wp.uint64(lane + 1) * _GOLDEN)
    return float(bits & _MASK) * _UNIT


@wp.func
def exponential(mean: float, number: float) -> float:
    """Exponentially distributed number, from a uniform one."""
    return -mean * wp.log(1.0 - number)


@wp.func
def heading_of(yaw: float) -> wp.vec2:
    return wp.vec2(wp.cos(yaw), wp.sin(yaw))


@wp.func
def left_of(direction: wp.vec2) -> wp.vec2:
    return wp.vec2(-direction[1], direction[0])


@wp.func
def wall_at(crowd: Crowd, row: int, point: wp.vec2) -> wp.vec3:
    """Distance to the nearest wall (m) and direction away from it, as :meth:`WallDistances.at` returns them."""
    slot = int(crowd.slots[row])
    cell = crowd.grids[slot, 2]
    rows = int(crowd.grids[slot, 3])
    columns = int(crowd.grids[slot, 4])
    u = (point[0] - crowd.grids[slot, 0]) / cell
    v = (point[1] - crowd.grids[slot, 1]) / cell
    i = wp.clamp(int(wp.floor(u)), 0, columns - 2)
    j = wp.clamp(int(wp.floor(v)), 0, rows - 2)
    corner = j * columns + i
    d00 = crowd.distances[slot, corner]
    d10 = crowd.distances[slot, corner + 1]
    d01 = crowd.distances[slot, corner + columns]
    d11 = crowd.distances[slot, corner + columns + 1]
    s = wp.clamp(u - float(i), 0.0, 1.0)
    t = wp.clamp(v - float(j), 0.0, 1.0)
    low = d00 + s * (d10 - d00)
    high = d01 + s * (d11 - d01)
    beyond = wp.max(wp.abs(u - float(i) - s), wp.abs(v - float(j) - t)) * cell
    rise = wp.vec2((1.0 - t) * (d10 - d00) + t * (d11 - d01), high - low)
    length = wp.length(rise)
    rise = wp.where(length > 1.0e-6, rise / length, wp.vec2(0.0, 0.0))
    return wp.vec3(low + t * (high - low) - beyond, rise[0], rise[1])


@wp.func
def kept_distance(crowd: Crowd, row: int, radius: float) -> float:
    """Distance that the center of a mover keeps from walls, m: its radius and the error of interpolation.

    Near a corner, the second derivative of the distance is 1 / distance, so that linear interpolation between points
    ``cell`` apart is up to ``cell^2 / (8 distance)`` too large.
    """
    cell = crowd.grids[int(crowd.slots[row]), 2]
    return radius + cell * cell / (8.0 * wp.max(radius, 0.5 * cell))


@wp.func
def free_way(crowd: Crowd, row: int, start: wp.vec2, end: wp.vec2, kept: float) -> float:
    """Length of the way from a point straight to another that keeps its distance from walls, m."""
    whole = wp.length(end - start)
    direction = (end - start) / wp.max(whole, 1.0e-6)
    way = float(0.0)
    for _step in range(128):
        gap = wall_at(crowd, row, start + way * direction)[0] - kept
        if gap < -0.02:
            return way
        way += wp.max(gap, 0.05)
        if way >= whole:
            return whole
    return way


@wp.func
def pieces_of(move: wp.vec2, kept: float) -> int:
    """Number of pieces of a move, none of which is longer than half of the distance from walls."""
    return wp.clamp(int(wp.ceil(2.0 * wp.length(move) / wp.max(kept, 0.01))), 1, 64)


@wp.func
def walked(crowd: Crowd, row: int, start: wp.vec2, move: wp.vec2, kept: float) -> wp.vec2:
    """Point to which a mover comes with a move, which walls stop or divert."""
    pieces = pieces_of(move, kept)
    point = start
    for _piece in range(pieces):
        to = point + move / float(pieces)
        gap = float(0.0)
        for push in range(5):
            wall = wall_at(crowd, row, to)
            gap = wall[0] - kept
            if gap >= 0.0:
                break
            if push < 4:
                to = to - gap * wp.vec2(wall[1], wall[2])
        # In a corner, it stays where it is.
        if gap > -SLACK:
            point = to
        elif gap + kept > wall_at(crowd, row, point)[0]:
            point = to
    return point


@wp.func
def turned(yaw: float, velocity: wp.vec2, dt: float) -> float:
    """Heading after a step of a mover that turns to where it walks."""
    if wp.length(velocity) < 0.02:
        return yaw
    turn = wp.atan2(velocity[1], velocity[0]) - yaw
    turn = turn - TWO_PI * wp.floor(turn / TWO_PI + 0.5)
    turned_yaw = yaw + wp.clamp(turn, -TURN_RATE * dt, TURN_RATE * dt)
    return turned_yaw - TWO_PI * wp.floor(turned_yaw / TWO_PI + 0.5)


@wp.func
def limits_of(crowd: Crowd, row: int, mover: int, area: int) -> wp.vec4:
    """Limits ``(x_low, x_high, y_low, y_high)`` of an area of the settings, or of the arena if there is none."""
    if crowd.settings[row, mover, area] == 0.0:
        return wp.vec4(crowd.arena[row, 0], crowd.arena[row, 2], crowd.arena[row, 1], crowd.arena[row, 3])
    x_low = crowd.settings[row, mover, area + 1]
    x_high = crowd.settings[row, mover, area + 2]
    return wp.vec4(x_low, x_high, crowd.settings[row, mover, area + 3], crowd.settings[row, mover, area + 4])


@wp.func
def drawn_in(crowd: Crowd, row: int, mover: int, area: int, draw: wp.uint64, number: int) -> wp.vec2:
    """Uniform point of an area."""
    limits = limits_of(crowd, row, mover, area)
    key = crowd.keys[row, mover]
    return wp.vec2(
        limits[0] + (limits[1] - limits[0]) * uniform(key, DRAWS, draw, 2 * number),
        limits[2] + (limits[3] - limits[2]) * uniform(key, DRAWS, draw, 2 * number + 1),
    )


@wp.func
def is_point(crowd: Crowd, row: int, mover: int, area: int) -> bool:
    """Whether an area of the settings is a single point."""
    limits = limits_of(crowd, row, mover, area)
    return crowd.settings[row, mover, area] > 0.0 and limits[0] == limits[1] and limits[2] == limits[3]


@wp.func
def draw_start(crowd: Crowd, placed: States, row: int, mover: int) -> wp.vec2:
    """Point at which an episode begins, free of walls, rovers and the movers that were placed before.

    Of points that are not, the one that lacks the least.
    """
    radius = crowd.radius[row, mover]
    kept = kept_distance(crowd, row, radius)
    best = drawn_in(crowd, row, mover, START, wp.uint64(0), 0)
    if is_point(crowd, row, mover, START):
        return best
    least = float(FAR)
    for number in range(CANDIDATES):
        point = drawn_in(crowd, row, mover, START, wp.uint64(0), number)
        lack = 100.0 * wp.max(0.0, kept - wall_at(crowd, row, point)[0])
        for k in range(crowd.rovers.shape[1]):
            gap = wp.length(point - crowd.rovers[row, k]) - radius - crowd.rover_radius
            lack += wp.max(0.0, FREE_OF_ROVER - gap)
        for other in range(mover):
            if crowd.mine[row, other]:
                gap = wp.length(point - placed.position[row, other]) - radius - crowd.radius[row, other]
                lack += wp.max(0.0, -gap)
        if lack < least:
            least = lack
            best = point
        if lack == 0.0:
            break
    return best


@wp.func
def draw_goal(crowd: Crowd, row: int, mover: int, point: wp.vec2, draws: wp.int64) -> wp.vec2:
    """Goal of a mover at a point: a free one of the area, by turns that of the start, or any that it sees."""
    area = int(GOAL)
    has_both = crowd.settings[row, mover, START] * crowd.settings[row, mover, GOAL] > 0.0
    if has_both and draws % wp.int64(2) == wp.int64(0):
        area = START
    draw = wp.uint64(draws)
    kept = kept_distance(crowd, row, crowd.radius[row, mover])
    seen = crowd.settings[row, mover, GOAL] == 0.0
    best = drawn_in(crowd, row, mover, area, draw, 0)
    if is_point(crowd, row, mover, area):
        return best
    most = float(-FAR)
    for number in range(CANDIDATES):
        goal = drawn_in(crowd, row, mover, area, draw, number)
        gap = wall_at(crowd, row, goal)[0] - kept
        if gap >= 0.0:
            # Both sides of an "or" would be evaluated.
            if not seen:
                return goal
            if free_way(crowd, row, point, goal, kept) >= wp.length(goal - point):
                return goal
        if gap > most:
            most = gap
            best = goal
    if seen:
        # Straight ahead in any direction, as far as there is a way.
        key = crowd.keys[row, mover]
        ahead = heading_of(TWO_PI * uniform(key, DRAWS, draw, 2 * CANDIDATES))
        return point + free_way(crowd, row, point, point + 10.0 * ahead, kept) * ahead
    return best


@wp.func
def way_to(crowd: Crowd, row: int, mover: int, point: wp.vec2, goal: wp.vec2, draws: wp.int64) -> wp.vec2:
    """Direction in which a mover walks to its goal: straight, or along the wall that is in its way."""
    toward = goal - point
    distance = wp.length(toward)
    if distance < 1.0e-4:
        return wp.vec2(0.0, 0.0)
    toward = toward / distance
    wall = wall_at(crowd, row, point)
    away = wp.vec2(wall[1], wall[2])
    gap = wall[0] - kept_distance(crowd, row, crowd.radius[row, mover])
    near = wp.clamp(1.0 - gap / BAND, 0.0, 1.0)
    inward = wp.dot(toward, away)
    if near == 0.0 or inward >= 0.0 or gap > distance:
        return toward
    along = left_of(away)
    side = wp.sign(wp.dot(toward, along))
    if inward < -0.7:
        # The goal is behind the wall: the side does not change until the next goal.
        side = wp.where(uniform(crowd.keys[row, mover], DRAWS, wp.uint64(draws), 2 * CANDIDATES + 1) < 0.5, 1.0, -1.0)
    return wp.normalize((1.0 - near) * toward + near * side * along)


@wp.func
def step_noise(crowd: Crowd, row: int, mover: int) -> wp.vec2:
    """Two uniform numbers in [-0.5, 0.5) of a mover in this step."""
    step = wp.uint64(wp.int64(crowd.time[row, 0] / wp.float64(crowd.dt) + wp.float64(0.5)))
    key = crowd.keys[row, mover]
    return wp.vec2(uniform(key, STEPS, step, 0) - 0.5, uniform(key, STEPS, step, 1) - 0.5)


@wp.func
def finish_step(crowd: Crowd, before: States, after: States, row: int, mover: int, point: wp.vec2, clock: float):
    """Stores where a mover is after a step, and draws another goal if it is there or makes no way.

    ``clock`` is the patience that is left, s, if it is positive. Time of full speed toward the goal adds to it, and
    time at less than half of it takes from it. A negative one is the rest of a pause.
    """
    dt = crowd.dt
    velocity = (point - before.position[row, mover]) / dt
    after.position[row, mover] = point
    after.velocity[row, mover] = velocity
    after.yaw[row, mover] = turned(before.yaw[row, mover], velocity, dt)
    goal = before.goal[row, mover]
    patience = crowd.settings[row, mover, PATIENCE]
    draws = before.draws[row, mover]
    renews = bool(False)
    if clock < 0.0:
        clock = clock + dt
        renews = clock > -0.5 * dt
    else:
        toward = goal - before.position[row, mover]
        progress = wp.dot(velocity, toward) / wp.max(wp.length(toward) * crowd.settings[row, mover, SPEED], 1.0e-6)
        clock = wp.min(clock + dt * (2.0 * progress - 1.0), patience)
        if wp.length(goal - point) < ARRIVED:
            if crowd.settings[row, mover, PAUSE] > 0.0:
                clock = -crowd.settings[row, mover, PAUSE]
            else:
                renews = True
        elif clock < 0.0:
            renews = True
    if renews:
        goal = draw_goal(crowd, row, mover, point, draws)
        draws = draws + wp.int64(1)
        clock = patience
    after.goal[row, mover] = goal
    after.draws[row, mover] = draws
    after.clock[row, mover] = clock
