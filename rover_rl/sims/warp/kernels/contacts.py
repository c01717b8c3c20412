"""Where a rover touches the world: under its wheels, under its chassis, and at obstacles.

A thread keeps its contacts in an array: two for each wheel, one at each edge of its tread, then a few more.
"""

from __future__ import annotations

from rover_rl.sims.warp.kernels.convex import is_near, overlap, part_center, part_radius
from rover_rl.sims.warp.kernels.ground import gap_to, ground_at, normal_of
from rover_rl.sims.warp.kernels.types import MAX_WHEELS, Rover, Scene, Solver
from rover_rl.sims.warp.library import wp

MORE_CONTACTS = 8
"""Contacts besides those of wheels with the ground; of more, the deepest count."""
MAX_CONTACTS = 2 * MAX_WHEELS + MORE_CONTACTS
NO_WHEEL = -1
SAMPLES = 3
"""Points of a wheel's edge below which the ground is looked at: at the bottom, ahead of it and behind."""
SAMPLE_COS, SAMPLE_SIN = 0.76604444, 0.64278761
"""Of the 40 degrees between them."""
GRIP = 0.57735027
"""Where between a tread's middle (0) and its edge (1) friction acts: with two points at 1 / sqrt(3), it resists turning
on the spot as that of a line of even pressure does (Gauss's quadrature)."""


@wp.struct
class Contact:
    """A contact and its three rows of the solver: along the normal and two tangents. In the rover's frame.

    For each direction: the moment that a unit impulse gives the body, what this makes of its angular velocity, and the
    moment that it gives the wheel about its axle.
    """

    live: int
    # Where an impulse of the substep before is kept under; equal for the same two things.
    key: int
    wheel: int
    gap: float
    friction: float
    # Speed along the normal that is asked for, m/s.
    bias: float
    normal: wp.vec3
    normal_moment: wp.vec3
    normal_turn: wp.vec3
    normal_spin: float
    ahead: wp.vec3
    ahead_moment: wp.vec3
    ahead_turn: wp.vec3
    ahead_spin: float
    side: wp.vec3
    side_moment: wp.vec3
    side_turn: wp.vec3
    side_spin: float
    # Inverse of the velocity that a unit impulse gives, along the normal and along the slower tangent.
    normal_mass: float
    tangent_mass: float
    # Impulses so far, N s: along the normal, ahead, to the side.
    impulse: wp.vec3


@wp.struct
class Body:
    """A rover in its own frame, for one substep.

    ``center`` is its centre of mass in the base frame, ``position`` where that is in the world; velocities are those
    of the centre of mass and about it.
    """

    center: wp.vec3
    position: wp.vec3
    rotation: wp.mat33
    velocity: wp.vec3
    angular_velocity: wp.vec3
    inverse_mass: float
    inverse_inertia: wp.mat33
    inverse_spin: float


@wp.func
def moment_of(arm: wp.vec3, direction: wp.vec3, spin: float) -> wp.vec3:
    """Moment of a unit impulse on the body, without what goes into the wheel's spin."""
    moment = wp.cross(arm, direction)
    return wp.vec3(moment[0], moment[1] - spin, moment[2])


@wp.func
def spin_of(lever: wp.vec3, direction: wp.vec3, wheel: int) -> float:
    """Moment of a unit impulse about the wheel's axle, of which ``lever`` is the arm."""
    return wp.where(wheel == NO_WHEEL, 0.0, lever[2] * direction[0] - lever[0] * direction[2])


@wp.func
def set_contact(
    contacts: wp.array[Contact],
    k: int,
    body: Body,
    rover: Rover,
    solver: Solver,
    wheel: int,
    arm: wp.vec3,
    grip: wp.vec3,
    normal: wp.vec3,
    gap: float,
    friction: float,
):
    """Fills in everything of contact ``k`` but its key and its impulse.

    Args:
        contacts: of a thread.
        k: which of them.
        body: the rover.
        rover: its figures.
        solver: numbers of the physics.
        wheel: that touches, or ``NO_WHEEL``.
        arm: from the centre of mass to the contact.
        grip: from there to where friction acts.
        normal: from what is touched to the rover.
        gap: distance of the two, m; negative if they overlap.
        friction: coefficient.
    """
    lever = arm
    if wheel != NO_WHEEL:
        lever = arm - (rover.hubs[wheel] - body.center)
    # Ahead is the way that a wheel rolls, where there is one.
    ahead = wp.vec3(normal[2], 0.0, -normal[0])
    if wp.abs(normal[1]) > 0.9:
        ahead = wp.vec3(normal[1], -normal[0], 0.0)
    ahead = wp.normalize(ahead)
    side = wp.cross(normal, ahead)
    normal_spin = spin_of(lever, normal, wheel)
    ahead_spin = spin_of(lever, ahead, wheel)
    side_spin = spin_of(lever, side, wheel)
    normal_moment = moment_of(arm, normal, normal_spin)
    ahead_moment = moment_of(grip, ahead, ahead_spin)
    side_moment = moment_of(grip, side, side_spin)
    normal_turn = body.inverse_inertia * normal_moment
    ahead_turn = body.inverse_inertia * ahead_moment
    side_turn = body.inverse_inertia * side_moment

    contacts[k].live = 1
    contacts[k].wheel = wheel
    contacts[k].gap = gap
    contacts[k].friction = friction
    contacts[k].normal = normal
    contacts[k].normal_moment = normal_moment
    contacts[k].normal_turn = normal_turn
    contacts[k].normal_spin = normal_spin
    contacts[k].ahead = ahead
    contacts[k].ahead_moment = ahead_moment
    contacts[k].ahead_turn = ahead_turn
    contacts[k].ahead_spin = ahead_spin
    contacts[k].side = side
    contacts[k].side_moment = side_moment
    contacts[k].side_turn = side_turn
    contacts[k].side_spin = side_spin
    contacts[k].normal_mass = 1.0 / (
        body.inverse_mass
        + wp.dot(normal_moment, normal_turn)
        + normal_spin * normal_spin * body.inverse_spin
        + solver.softness
    )
    # One step for both tangents keeps the friction's direction: with two it would turn away from the slip.
    contacts[k].tangent_mass = 1.0 / (
        body.inverse_mass
        + wp.max(
            wp.dot(ahead_moment, ahead_turn) + ahead_spin * ahead_spin * body.inverse_spin,
            wp.dot(side_moment, side_turn) + side_spin * side_spin * body.inverse_spin,
        )
    )
    if gap > 0.0:
        contacts[k].bias = -gap / solver.dt
    else:
        contacts[k].bias = wp.min(-gap * solver.correction / solver.dt, solver.max_correction)


@wp.func
def wheels_on_ground(
    contacts: wp.array[Contact], scene: Scene, body: Body, rover: Rover, solver: Solver, friction: float
):
    """Two contacts for each wheel: where each edge of its tread is deepest in the ground."""
    back = wp.transpose(body.rotation)
    down = back * wp.vec3(0.0, 0.0, -1.0)
    # The way down within the planes of the wheels; of a rover on its side, any will do.
    bottom = wp.vec3(down[0], 0.0, down[2])
    bottom = wp.where(wp.length_sq(bottom) > 1.0e-6, wp.normalize(bottom), wp.vec3(0.0, 0.0, -1.0))
    for k in range(2 * rover.wheels):
        wheel = k // 2
        offset = wp.where(k % 2 == 0, rover.wheel_half_width, -rover.wheel_half_width)
        middle = rover.hubs[wheel] - body.center + wp.vec3(0.0, offset, 0.0)
        best_gap = float(1.0e9)
        best_arm = middle
        best_normal = wp.vec3(0.0, 0.0, 1.0)
        for n in range(SAMPLES + 1):
            direction = bottom
            if n == 1:
                direction = SAMPLE_COS * bottom + SAMPLE_SIN * wp.vec3(bottom[2], 0.0, -bottom[0])
            elif n == 2:
                direction = SAMPLE_COS * bottom - SAMPLE_SIN * wp.vec3(bottom[2], 0.0, -bottom[0])
            elif n == SAMPLES:
                # The point of the edge that is deepest below the plane of the deepest sample.
                towards = wp.vec3(-best_normal[0], 0.0, -best_normal[2])
                direction = wp.where(wp.length_sq(towards) > 1.0e-6, wp.normalize(towards), bottom)
            arm = middle + rover.wheel_radius * direction
            point = body.position + body.rotation * arm
            ground = ground_at(scene, point[0], point[1])
            gap = gap_to(ground, point[2])
            if gap < best_gap:
                best_gap = gap
                best_arm = arm
                best_normal = back * normal_of(ground)
        if best_gap < solver.margin:
            grip = best_arm - wp.vec3(0.0, (1.0 - GRIP) * offset, 0.0)
            set_contact(contacts, k, body, rover, solver, wheel, best_arm, grip, best_normal, best_gap, friction)
        else:
            contacts[k].live = 0
            contacts[k].impulse = wp.vec3(0.0, 0.0, 0.0)


@wp.func
def add_contact(
    contacts: wp.array[Contact],
    count: int,
    body: Body,
    rover: Rover,
    solver: Solver,
    key: int,
    wheel: int,
    arm: wp.vec3,
    normal: wp.vec3,
    gap: float,
    friction: float,
) -> int:
    """Adds a contact to the ``count`` that there are; if there is no room, in the place of the shallowest."""
    first = 2 * rover.wheels
    k = count
    if count == first + MORE_CONTACTS:
        k = first
        for other in range(first + 1, count):
            if contacts[other].gap > contacts[k].gap:
                k = other
        if contacts[k].gap <= gap:
            return count
    set_contact(contacts, k, body, rover, solver, wheel, arm, arm, normal, gap, friction)
    contacts[k].key = key
    contacts[k].impulse = wp.vec3(0.0, 0.0, 0.0)
    return wp.max(count, k + 1)


@wp.func
def chassis_on_ground(
    contacts: wp.array[Contact], count: int, scene: Scene, body: Body, rover: Rover, solver: Solver, friction: float
) -> int:
    """Contacts of the chassis' points with the ground."""
    back = wp.transpose(body.rotation)
    for n in range(rover.points.shape[0]):
        arm = rover.points[n] - body.center
        point = body.position + body.rotation * arm
        ground = ground_at(scene, point[0], point[1])
        gap = gap_to(ground, point[2])
        if gap < 0.0:
            normal = back * normal_of(ground)
            count = add_contact(contacts, count, body, rover, solver, n + 1, NO_WHEEL, arm, normal, gap, friction)
    return count


@wp.func
def ground_in_chassis(
    contacts: wp.array[Contact], count: int, scene: Scene, body: Body, rover: Rover, solver: Solver, friction: float
) -> int:
    """Contacts of the ground's peaks, which are corners of its triangles, with the boxes of the chassis."""
    back = wp.transpose(body.rotation)
    columns = scene.heights.shape[1]
    upright = wp.sign(body.rotation[2, 2])
    for box in range(rover.box_centers.shape[0]):
        center = rover.box_centers[box] - body.center
        half = rover.box_halves[box]
        middle = body.position + body.rotation * center
        reach = wp.length(half)
        left = wp.max(int(wp.ceil((middle[0] - reach - scene.corner[0]) / scene.cell)), 0)
        right = wp.min(int(wp.floor((middle[0] + reach - scene.corner[0]) / scene.cell)), columns - 1)
        bottom = wp.max(int(wp.ceil((middle[1] - reach - scene.corner[1]) / scene.cell)), 0)
        top = wp.min(int(wp.floor((middle[1] + reach - scene.corner[1]) / scene.cell)), scene.heights.shape[0] - 1)
        for j in range(bottom, top + 1):
            for i in range(left, right + 1):
                x = scene.corner[0] + float(i) * scene.cell
                y = scene.corner[1] + float(j) * scene.cell
                peak = back * (wp.vec3(x, y, scene.heights[j, i]) - body.position)
                local = peak - center
                free_x = wp.abs(local[0]) - half[0]
                free_y = wp.abs(local[1]) - half[1]
                # A peak has ground below it, so that it comes in from the side that looks down.
                free_z = -half[2] - upright * local[2]
                gap = wp.max(free_x, wp.max(free_y, free_z))
                if gap < 0.0 and wp.abs(local[2]) < half[2]:
                    normal = wp.vec3(0.0, 0.0, upright)
                    if gap == free_x:
                        normal = wp.vec3(-wp.sign(local[0]), 0.0, 0.0)
                    elif gap == free_y:
                        normal = wp.vec3(0.0, -wp.sign(local[1]), 0.0)
                    key = -1 - (j * columns + i)
                    count = add_contact(
                        contacts, count, body, rover, solver, key, NO_WHEEL, peak, normal, gap, friction
                    )
    return count


@wp.func
def rover_at_obstacles(
    contacts: wp.array[Contact], count: int, scene: Scene, body: Body, rover: Rover, solver: Solver, friction: float
) -> int:
    """Contacts of the boxes and wheels with obstacles, one for each pair."""
    if scene.near_columns == 0:
        return count
    column = wp.clamp(int((body.position[0] - scene.near_corner[0]) / scene.near_cell), 0, scene.near_columns - 1)
    row = wp.clamp(int((body.position[1] - scene.near_corner[1]) / scene.near_cell), 0, scene.near_rows - 1)
    cell = row * scene.near_columns + column
    boxes = rover.box_centers.shape[0]
    for n in range(scene.near_starts[cell], scene.near_starts[cell + 1]):
        obstacle = scene.near[n]
        if is_near(scene, obstacle, body.position, rover.reach):
            for part in range(boxes + rover.wheels):
                middle = body.position + body.rotation * (part_center(rover, part) - body.center)
                if is_near(scene, obstacle, middle, part_radius(rover, part)):
                    hit = overlap(scene, rover, body.center, body.position, body.rotation, part, obstacle)
                    if hit.depth > 0.0:
                        key = 1024 + obstacle * (boxes + rover.wheels) + part
                        wheel = wp.where(part < boxes, NO_WHEEL, part - boxes)
                        count = add_contact(
                            contacts,
                            count,
                            body,
                            rover,
                            solver,
                            key,
                            wheel,
                            hit.arm,
                            hit.normal,
                            -hit.depth,
                            friction,
                        )
    return count


@wp.func
def remembered(contacts: wp.array[Contact], first: int, count: int, keys: wp.array[int], impulses: wp.array[wp.vec3]):
    """Gives contacts from ``first`` on the impulses of the substep before, by their keys."""
    for k in range(first, count):
        for n in range(MORE_CONTACTS):
            if keys[n] == contacts[k].key:
                contacts[k].impulse = impulses[n]
    for n in range(MORE_CONTACTS):
        k = first + n
        if k < count:
            keys[n] = contacts[k].key
        else:
            keys[n] = 0
