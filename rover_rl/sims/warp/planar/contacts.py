"""Contacts of the outline of a rover with obstacles and movers, seen from above.

Two outlines touch where a corner of one meets an edge of the other. So the corners of the rover are tested against the
edges of an obstacle, and the first end of each edge against the rectangles of the rover. A contact begins before the
surfaces meet: its row lets them approach until they touch at the end of the substep (speculative contact).

Points, normals and velocities are in the body frame, m and m/s.
"""

from __future__ import annotations

from rover_rl.native.warp import wp
from rover_rl.sims.warp.planar.plan import MAX_MARGIN, Plan, cell_at
from rover_rl.sims.warp.planar.robots import PlanarRobot
from rover_rl.worlds.movers.part_kernels import BOX, PartArrays

MAX_TOUCHES = 12
"""Maximum number of contacts of a rover; the nearest are kept."""
MAX_DEPTH = 0.05
"""Depth of a corner behind an edge from which on it is another edge's, m."""
ERROR_REDUCTION, MAX_CORRECTION = 0.3, 1.0
"""Share of a penetration that a substep removes, and the maximum speed at which it does, m/s."""
MARGIN = 0.01
"""Least distance at which contacts are looked for, m."""


@wp.struct
class Touch:
    """A contact: Jacobian rows (direction, moment) along its normal, from the obstacle to the rover, and its tangent.

    The speed along the normal must be at least ``bias``; the obstacle moves at ``drift`` along the tangent. ``impulse``
    is the normal impulse of the last iteration, N s.
    """

    normal: wp.vec3
    tangent: wp.vec3
    gap: float
    bias: float
    drift: float
    impulse: float
    of_mover: bool


@wp.struct
class Outline:
    """Rover in a substep: position of the center of mass, direction ahead, and center in the base frame."""

    position: wp.vec2
    ahead: wp.vec2
    center: wp.vec2
    # Distance at which contacts begin, and inverse of the duration of the substep.
    margin: float
    rate: float
    row: int


@wp.struct
class Surface:
    """Surface of an obstacle: lowest and highest point above the ground (m), and its motion in the body frame.

    It moves at ``velocity`` (m/s) at ``place`` and turns at ``turn``, rad/s.
    """

    low: float
    high: float
    velocity: wp.vec2
    place: wp.vec2
    turn: float
    of_mover: bool


@wp.func
def turned(vector: wp.vec2, ahead: wp.vec2) -> wp.vec2:
    """Turns a vector of the body frame into the world frame."""
    return wp.vec2(ahead[0] * vector[0] - ahead[1] * vector[1], ahead[1] * vector[0] + ahead[0] * vector[1])


@wp.func
def unturned(vector: wp.vec2, ahead: wp.vec2) -> wp.vec2:
    """Turns a vector of the world frame into the body frame."""
    return wp.vec2(ahead[0] * vector[0] + ahead[1] * vector[1], ahead[0] * vector[1] - ahead[1] * vector[0])


@wp.func
def add_touch(
    touches: wp.array[Touch], count: int, outline: Outline, surface: Surface, normal: wp.vec2, arm: wp.vec2, gap: float
) -> int:
    """Appends a contact at ``arm``, and returns the new count. If the array is full, the farthest one is left out."""
    k = int(count)
    if count == MAX_TOUCHES:
        k = int(0)
        for other in range(1, count):
            if touches[other].gap > touches[k].gap:
                k = other
        if touches[k].gap <= gap:
            return count
    along = wp.vec2(-normal[1], normal[0])
    offset = arm - surface.place
    moving = surface.velocity + surface.turn * wp.vec2(-offset[1], offset[0])
    bias = -gap * outline.rate
    if gap < 0.0:
        bias = wp.min(ERROR_REDUCTION * bias, MAX_CORRECTION)
    touches[k].normal = wp.vec3(normal[0], normal[1], arm[0] * normal[1] - arm[1] * normal[0])
    touches[k].tangent = wp.vec3(along[0], along[1], arm[0] * along[1] - arm[1] * along[0])
    touches[k].gap = gap
    touches[k].bias = bias + wp.dot(normal, moving)
    touches[k].drift = wp.dot(along, moving)
    touches[k].impulse = 0.0
    touches[k].of_mover = surface.of_mover
    return wp.max(count, k + 1)


@wp.func
def steered_point(robot: PlanarRobot, axles: wp.array[wp.vec2], wheel: int, point: wp.vec2, center: wp.vec2) -> wp.vec2:
    """A point of the base frame in the body frame, turned about the hub of a wheel if it is on one that steers."""
    if wheel < 0:
        return point - center
    hub = robot.hubs[wheel]
    return hub + turned(point - hub, axles[wheel]) - center


@wp.func
def meets(surface: Surface, low: float, high: float) -> bool:
    return low < surface.high and high > surface.low


@wp.func
def touch_disc(
    touches: wp.array[Touch],
    count: int,
    robot: PlanarRobot,
    axles: wp.array[wp.vec2],
    outline: Outline,
    surface: Surface,
    center: wp.vec2,
    radius: float,
) -> int:
    """Adds the contacts of the rover with a disc, or with a corner, whose radius is 0; returns the count."""
    for n in range(robot.boxes.shape[0]):
        span = robot.box_spans[n]
        if meets(surface, span[0], span[1]):
            box = robot.boxes[n]
            wheel = robot.wheel_of_box[n]
            local = center - steered_point(robot, axles, wheel, wp.vec2(box[0], box[1]), outline.center)
            if wheel >= 0:
                local = unturned(local, axles[wheel])
            nearest = wp.vec2(wp.clamp(local[0], -box[2], box[2]), wp.clamp(local[1], -box[3], box[3]))
            away = nearest - local
            distance = wp.length(away)
            # Two corners that pass by each other do not touch; if they do, the next substep finds one inside.
            passes = radius == 0.0 and away[0] * away[1] != 0.0
            if distance < radius + outline.margin and not passes:
                normal = away / wp.max(distance, 1.0e-6)
                gap = distance - radius
                if distance < 1.0e-6:
                    # The middle of the disc is inside of the rectangle: leave through the nearest side.
                    gap_x = wp.abs(local[0]) - box[2]
                    gap_y = wp.abs(local[1]) - box[3]
                    normal = wp.vec2(-wp.sign(local[0]), 0.0)
                    if gap_y > gap_x:
                        normal = wp.vec2(0.0, -wp.sign(local[1]))
                    gap = wp.max(gap_x, gap_y) - radius
                offset = nearest - local
                if wheel >= 0:
                    normal = turned(normal, axles[wheel])
                    offset = turned(offset, axles[wheel])
                count = add_touch(touches, count, outline, surface, normal, center + offset, gap)
    return count


@wp.func
def touch_edge(
    touches: wp.array[Touch],
    count: int,
    robot: PlanarRobot,
    axles: wp.array[wp.vec2],
    outline: Outline,
    surface: Surface,
    start: wp.vec2,
    end: wp.vec2,
) -> int:
    """Adds the contacts of the rover with an edge of an obstacle, and with the corner at its start."""
    reach = robot.reach + outline.margin
    along = end - start
    length = wp.length(along)
    along = along / length
    normal = wp.vec2(along[1], -along[0])
    # The center of mass is in front of an edge that the rover meets, and not farther away than it reaches.
    distance = -wp.dot(normal, start)
    middle = -wp.dot(along, start)
    if distance > reach or middle < -reach or middle > length + reach:
        return count
    if wp.length_sq(start) < reach * reach:
        count = touch_disc(touches, count, robot, axles, outline, surface, start, 0.0)
    if distance > 0.0:
        for n in range(robot.corners.shape[0]):
            corner = robot.corners[n]
            point = wp.vec2(corner[0], corner[1])
            arm = steered_point(robot, axles, robot.wheel_of_corner[n], point, outline.center)
            gap = wp.dot(normal, arm - start)
            if gap < outline.margin and gap > -MAX_DEPTH and meets(surface, corner[2], corner[3]):
                beside = wp.dot(along, arm - start)
                if beside >= 0.0 and beside <= length:
                    count = add_touch(touches, count, outline, surface, normal, arm, gap)
    return count


@wp.func
def touch_obstacles(
    touches: wp.array[Touch], count: int, plan: Plan, robot: PlanarRobot, axles: wp.array[wp.vec2], outline: Outline
) -> int:
    """Adds the contacts with obstacles; returns the count."""
    cell = cell_at(plan.near, outline.position[0], outline.position[1])
    if cell < 0:
        return count
    surface = Surface()
    for k in range(plan.near_starts[cell], plan.near_starts[cell + 1]):
        number = plan.near_edges[k]
        edge = plan.edges[number]
        span = plan.spans[number]
        surface.low = span[0]
        surface.high = span[1]
        start = unturned(wp.vec2(edge[0], edge[1]) - outline.position, outline.ahead)
        end = unturned(wp.vec2(edge[2], edge[3]) - outline.position, outline.ahead)
        count = touch_edge(touches, count, robot, axles, outline, surface, start, end)
    return count


@wp.func
def touch_movers(
    touches: wp.array[Touch],
    count: int,
    ground: float,
    robot: PlanarRobot,
    axles: wp.array[wp.vec2],
    outline: Outline,
    parts: PartArrays,
    rest: float,
) -> int:
    """Adds the contacts with the parts of movers; returns the count.

    A part is at its pose at the end of the control step, ``rest`` (s) from the start of this substep. A box, and what
    lies on its side, is a rectangle, and everything else a disc.
    """
    row = outline.row
    surface = Surface()
    surface.of_mover = True
    for n in range(parts.kind.shape[1]):
        if parts.kind[row, n] < 0:
            continue
        half = parts.half[row, n]
        velocity = parts.velocity[row, n]
        position = parts.position[row, n] - rest * velocity
        away = wp.vec2(position[0], position[1]) - outline.position
        reach = robot.reach + MAX_MARGIN + wp.length(half)
        if wp.length_sq(away) > reach * reach:
            continue
        orientation = parts.orientation[row, n]
        axis = wp.quat_rotate(orientation, wp.vec3(0.0, 0.0, 1.0))
        first = wp.quat_rotate(orientation, wp.vec3(1.0, 0.0, 0.0))
        long = half[0]
        wide = half[1]
        tall = half[2]
        is_box = parts.kind[row, n] == BOX
        if wp.abs(axis[2]) < 0.5:
            # A wheel: its axis is horizontal.
            is_box = True
            first = axis
            long = half[2]
            tall = half[0]
        turn = -rest * parts.turn[row, n]
        spun = turned(wp.normalize(wp.vec2(first[0], first[1])), wp.vec2(wp.cos(turn), wp.sin(turn)))
        ahead = unturned(spun, outline.ahead)
        surface.low = position[2] - tall - ground
        surface.high = position[2] + tall - ground
        surface.velocity = unturned(wp.vec2(velocity[0], velocity[1]), outline.ahead)
        surface.place = unturned(away, outline.ahead)
        surface.turn = parts.turn[row, n]
        if is_box:
            corner = turned(wp.vec2(long, wide), ahead)
            other = turned(wp.vec2(-long, wide), ahead)
            # Corners counter-clockwise: a, b, -a, -b from the middle.
            sides = int(4)
            for edge in range(sides):
                start = surface.place + wp.where(edge % 2 == 0, corner, other) * wp.where(edge < 2, 1.0, -1.0)
                end = surface.place + wp.where(edge % 2 == 0, other, corner) * wp.where(
                    edge == 0 or edge == 3, 1.0, -1.0
                )
                count = touch_edge(touches, count, robot, axles, outline, surface, start, end)
        else:
            count = touch_disc(touches, count, robot, axles, outline, surface, surface.place, half[0])
    return count
