"""Collision detection, and the constraint rows of each contact.

A thread stores contacts in one array: first the two of every wheel with the ground, at fixed indices (one at each edge
of the tread), then up to ``EXTRA_CONTACTS`` others, of the chassis with the ground, and of the rover with obstacles and
movers. Arms, normals and tangents are in the body frame, terrain and obstacles in the world frame. Lengths in m.

Constraint rows. The generalized velocity is ``u = (v, w, s_1, ..., s_W)``: velocity of the center of mass (m/s) and
angular velocity (rad/s), both in the body frame, and the absolute spin rate of each wheel about its axle e (rad/s),
which is e_y unless the wheel is steered. A wheel's center of mass lies on its axle, so that the mass matrix is ``M =
diag(m, I, J, ..., J)`` with the axle inertia J of the wheels kept out of I. A point at ``arm`` on a wheel with the hub
at ``arm - lever`` moves along a direction d with

    d . v + (arm x d - a e) . w + a s,    a = e . (lever x d),

and a point on the chassis with a = 0. The coefficients are one row of the Jacobian: direction, ``moment`` and ``axle``
entry. ``response`` is ``I^-1 moment``, the change of w per unit impulse, and ``1 / (row M^-1 row^T)`` is the effective
mass (E. Catto, "Iterative Dynamics with Temporal Coherence", GDC 2005).
"""

from __future__ import annotations

from rover_rl.native.warp import wp
from rover_rl.sims.scenes.scene import Scene, ground_at, ground_gap, ground_normal
from rover_rl.sims.warp.kernels.convex import find_overlap, is_near, is_straight, part_center, part_radius
from rover_rl.sims.warp.kernels.types import MAX_WHEELS, Body, MoverArrays, RobotModel, Solver

EXTRA_CONTACTS = 8
"""Maximum number of contacts besides those of the wheels with the ground; the deepest are kept."""
MAX_CONTACTS = 2 * MAX_WHEELS + EXTRA_CONTACTS
MAX_PAIRS = 16
"""Number of pairs of a part of the rover and an obstacle that are collected before they are tested."""
LEFT = wp.constant(wp.vec3(0.0, 1.0, 0.0))
"""Direction of the axle of a wheel that points ahead, in the base frame."""
UP = wp.constant(wp.vec3(0.0, 0.0, 1.0))
AT_REST = wp.constant(wp.vec3(0.0, 0.0, 0.0))
"""Velocity of what does not move."""
OBSTACLE_KEYS = 1024
"""Least key of a contact with an obstacle, above those of the points of the chassis."""
MOVER_KEYS = 1 << 24
"""Least key of a contact with a mover."""
NO_WHEEL = -1
"""Wheel index of a contact of the chassis."""
SAMPLES = 3
"""Points of a wheel's edge that are tested against the ground: the lowest point, one behind it and one ahead of it."""
SAMPLE_COS, SAMPLE_SIN = 0.76604444, 0.64278761
"""Cosine and sine of the angle between two samples, 40 degrees."""
FRICTION_POINT = 0.57735027
"""Point at which friction acts, between the middle (0) and the edge (1) of a tread: 1 / sqrt(3). Two forces there
resist turning on the spot as a line of uniform pressure does (two-point Gauss-Legendre quadrature)."""


@wp.struct
class Row:
    """A constraint row, in the body frame: entries of the Jacobian, and the change of w per unit impulse."""

    direction: wp.vec3
    moment: wp.vec3
    response: wp.vec3
    axle: float


@wp.struct
class Contact:
    """A contact and its three constraint rows. Body frame."""

    # 1 if the contact takes part in the current substep, else 0.
    active: int
    # Contact point, and the point where friction acts, relative to the center of mass, m.
    arm: wp.vec3
    friction_arm: wp.vec3
    # Unit normal from the other surface to the rover, and velocity of that surface at the contact point, m/s.
    direction: wp.vec3
    surface: wp.vec3
    # Identifies the same pair of features in the next substep, for the warm start.
    key: int
    # Index of the touching wheel, or NO_WHEEL.
    wheel: int
    # Distance of the two surfaces (m), negative for a penetration, and friction coefficient.
    gap: float
    friction: float
    # Target speed along the normal, m/s: removes penetration, admits approach across a gap, follows the other surface.
    bias: float
    # Speed of the other surface along the two tangents, m/s.
    drift: wp.vec2
    normal: Row
    longitudinal: Row
    lateral: Row
    # Effective masses, kg: along the normal (with softness), and one for both tangents.
    normal_mass: float
    tangent_mass: float
    # Accumulated impulses, N s: normal, longitudinal, lateral.
    impulse: wp.vec3


@wp.func
def rolling_direction(axle: wp.vec3, normal: wp.vec3) -> wp.vec3:
    if is_straight(axle):
        return wp.vec3(normal[2], 0.0, -normal[0])
    return wp.cross(axle, normal)


@wp.func
def bottom_of(axle: wp.vec3, down: wp.vec3) -> wp.vec3:
    """Downward direction in the plane of a wheel; undefined for a rover on its side, where any direction will do."""
    bottom = down - wp.dot(down, axle) * axle
    return wp.where(wp.length_sq(bottom) > 1.0e-6, wp.normalize(bottom), wp.vec3(0.0, 0.0, -1.0))


@wp.func
def make_row(
    arm: wp.vec3, lever: wp.vec3, direction: wp.vec3, axle: wp.vec3, wheel: int, inverse_inertia: wp.mat33
) -> Row:
    """Constraint row of a point along a direction: ``a = e . (lever x d)``, 0 on the chassis, and ``arm x d - a e``."""
    row = Row()
    row.direction = direction
    spin = float(0.0)
    if wheel != NO_WHEEL:
        if is_straight(axle):
            spin = lever[2] * direction[0] - lever[0] * direction[2]
        else:
            spin = wp.dot(axle, wp.cross(lever, direction))
    whole = wp.cross(arm, direction)
    moment = whole - spin * axle
    if is_straight(axle):
        moment = wp.vec3(whole[0], whole[1] - spin, whole[2])
    row.axle = spin
    row.moment = moment
    row.response = inverse_inertia * moment
    return row


@wp.func
def inverse_mass_of(row: Row, inverse_spin: float) -> float:
    """What the rotation of the body and the spin of the wheel add to the inverse of the effective mass, 1/kg."""
    return wp.dot(row.moment, row.response) + row.axle * row.axle * inverse_spin


@wp.func
def set_contact(
    contacts: wp.array[Contact],
    k: int,
    wheel: int,
    arm: wp.vec3,
    friction_arm: wp.vec3,
    normal: wp.vec3,
    gap: float,
    friction: float,
    surface: wp.vec3,
):
    """Sets where contact ``k`` is, see :class:`Contact`; its key and accumulated impulse stay as they are."""
    contacts[k].active = 1
    contacts[k].wheel = wheel
    contacts[k].arm = arm
    contacts[k].friction_arm = friction_arm
    contacts[k].direction = normal
    contacts[k].gap = gap
    contacts[k].friction = friction
    contacts[k].surface = surface


@wp.func
def prepare_contacts(
    contacts: wp.array[Contact], count: int, body: Body, model: RobotModel, solver: Solver, axles: wp.array[wp.vec3]
):
    """Fills in the constraint rows of the active ones among the first ``count`` contacts.

    All after the search: neighboring threads of a GPU, which find contacts at different times, do this together.

    Effective masses: ``m_n = 1 / (1/m + moment . response + a^2 / J + softness)``, and for friction the smaller of the
    two tangents' masses without softness. Target speed along the normal:

        gap > 0:   bias = -gap / dt, the surfaces may just meet at the end of the substep (speculative contact)
        gap <= 0:  bias = min(ERP depth / dt, max_correction), the penetration is reduced

    The speed of the other surface along the normal is added.
    """
    for k in range(count):
        if contacts[k].active == 1:
            wheel = contacts[k].wheel
            arm = contacts[k].arm
            friction_arm = contacts[k].friction_arm
            normal = contacts[k].direction
            axle = LEFT
            lever = arm
            if wheel != NO_WHEEL:
                axle = axles[wheel]
                lever = arm - (model.hubs[wheel] - body.center)
            # Longitudinal: the rolling direction of a wheel, axle x normal. On contacts near the axle's direction,
            # where that vanishes, normal x z.
            longitudinal = rolling_direction(axle, normal)
            if wp.abs(wp.dot(axle, normal)) > 0.9:
                longitudinal = wp.vec3(normal[1], -normal[0], 0.0)
            longitudinal = wp.normalize(longitudinal)
            lateral = wp.cross(normal, longitudinal)
            if wheel != NO_WHEEL and model.rollers.shape[0] > 0:
                # Ideal rollers: friction acts along the axle of the roller, and nothing holds the wheel across it.
                roller = model.rollers[wheel]
                if wp.length_sq(roller) > 0.0:
                    longitudinal = wp.normalize(roller - wp.dot(roller, normal) * normal)
                    lateral = wp.vec3(0.0, 0.0, 0.0)
            inertia = body.inverse_inertia
            spin = body.inverse_spin
            normal_row = make_row(arm, lever, normal, axle, wheel, inertia)
            longitudinal_row = make_row(friction_arm, lever, longitudinal, axle, wheel, inertia)
            lateral_row = make_row(friction_arm, lever, lateral, axle, wheel, inertia)
            contacts[k].normal = normal_row
            contacts[k].longitudinal = longitudinal_row
            contacts[k].lateral = lateral_row
            contacts[k].normal_mass = 1.0 / (
                body.inverse_mass
                + wp.dot(normal_row.moment, normal_row.response)
                + normal_row.axle * normal_row.axle * body.inverse_spin
                + solver.softness
            )
            # Both tangents take steps of the same size, so that the friction stays opposite to the slip; with a step of
            # its own for each, it would turn toward the tangent with the larger mass.
            contacts[k].tangent_mass = 1.0 / (
                body.inverse_mass + wp.max(inverse_mass_of(longitudinal_row, spin), inverse_mass_of(lateral_row, spin))
            )
            gap = contacts[k].gap
            if gap > 0.0:
                contacts[k].bias = -gap / solver.dt
            else:
                contacts[k].bias = wp.min(-gap * solver.error_reduction / solver.dt, solver.max_correction)
            surface = contacts[k].surface
            contacts[k].bias += wp.dot(normal, surface)
            contacts[k].drift = wp.vec2(wp.dot(longitudinal, surface), wp.dot(lateral, surface))


@wp.func
def collide_wheels_with_ground(
    contacts: wp.array[Contact],
    scene: Scene,
    body: Body,
    model: RobotModel,
    solver: Solver,
    axles: wp.array[wp.vec3],
    friction: float,
):
    """Finds two contacts per wheel: the deepest point of each of the end circles of its cylinder.

    Tests the lowest point, the points 40 degrees behind and ahead, which find steps and peaks, and the exact deepest
    point below the terrain plane of the deepest sample, ``arm = middle - r p / |p|`` with the part p of the normal in
    the wheel's plane.
    """
    to_body = wp.transpose(body.rotation)
    down = to_body * wp.vec3(0.0, 0.0, -1.0)
    straight_bottom = bottom_of(LEFT, down)
    for k in range(2 * model.wheels):
        wheel = k // 2
        axle = axles[wheel]
        bottom = straight_bottom
        if not is_straight(axle):
            bottom = bottom_of(axle, down)
        offset = wp.where(k % 2 == 0, model.wheel_half_width, -model.wheel_half_width)
        middle = model.hubs[wheel] - body.center + offset * axle
        best_gap = float(1.0e9)
        best_arm = middle
        best_normal = wp.vec3(0.0, 0.0, 1.0)
        for n in range(SAMPLES + 1):
            direction = bottom
            if n == 1:
                direction = SAMPLE_COS * bottom + SAMPLE_SIN * rolling_direction(axle, bottom)
            elif n == 2:
                direction = SAMPLE_COS * bottom - SAMPLE_SIN * rolling_direction(axle, bottom)
            elif n == SAMPLES:
                # Deepest point of the circle below the terrain plane of the deepest sample.
                inward = wp.dot(best_normal, axle) * axle - best_normal
                direction = wp.where(wp.length_sq(inward) > 1.0e-6, wp.normalize(inward), bottom)
            arm = middle + model.wheel_radius * direction
            point = body.position + body.rotation * arm
            ground = ground_at(scene, point[0], point[1])
            gap = ground_gap(ground, point[2])
            if gap < best_gap:
                best_gap = gap
                best_arm = arm
                best_normal = to_body * ground_normal(ground)
        if best_gap < solver.margin:
            inset = 1.0 - FRICTION_POINT
            if model.rollers.shape[0] > 0:
                if wp.length_sq(model.rollers[wheel]) > 0.0:
                    # A roller touches the ground below the hub.
                    inset = 1.0
            friction_arm = best_arm - inset * offset * axle
            set_contact(contacts, k, wheel, best_arm, friction_arm, best_normal, best_gap, friction, AT_REST)
        else:
            contacts[k].active = 0
            contacts[k].impulse = wp.vec3(0.0, 0.0, 0.0)


@wp.func
def add_contact(
    contacts: wp.array[Contact],
    count: int,
    model: RobotModel,
    key: int,
    wheel: int,
    arm: wp.vec3,
    normal: wp.vec3,
    gap: float,
    friction: float,
    surface: wp.vec3,
) -> int:
    """Appends an extra contact, and returns the new count. If the array is full, the shallowest one is left out."""
    first = 2 * model.wheels
    k = count
    if count == first + EXTRA_CONTACTS:
        k = first
        for other in range(first + 1, count):
            if contacts[other].gap > contacts[k].gap:
                k = other
        if contacts[k].gap <= gap:
            return count
    set_contact(contacts, k, wheel, arm, arm, normal, gap, friction, surface)
    contacts[k].key = key
    contacts[k].impulse = wp.vec3(0.0, 0.0, 0.0)
    return wp.max(count, k + 1)


@wp.func
def collide_chassis_with_ground(
    contacts: wp.array[Contact], count: int, scene: Scene, body: Body, model: RobotModel, friction: float
) -> int:
    """Adds a contact for each sample point of the chassis that is below the ground; returns the contact count."""
    to_body = wp.transpose(body.rotation)
    for n in range(model.chassis_points.shape[0]):
        arm = model.chassis_points[n] - body.center
        point = body.position + body.rotation * arm
        ground = ground_at(scene, point[0], point[1])
        gap = ground_gap(ground, point[2])
        if gap < 0.0:
            normal = to_body * ground_normal(ground)
            # Keys: 1 to the number of points.
            count = add_contact(contacts, count, model, n + 1, NO_WHEEL, arm, normal, gap, friction, AT_REST)
    return count


@wp.func
def collide_peaks_with_chassis(
    contacts: wp.array[Contact], count: int, scene: Scene, body: Body, model: RobotModel, friction: float
) -> int:
    """Adds a contact for each grid point of the ground inside a chassis box; returns the contact count.

    It finds narrow peaks between the sample points of the chassis. The contact normal is the box face of least
    penetration, among the sides and the face that looks down.
    """
    to_body = wp.transpose(body.rotation)
    columns = scene.heights.shape[1]
    # -1 for a rover upside down, whose roof looks down.
    upright = wp.sign(body.rotation[2, 2])
    for box in range(model.box_centers.shape[0]):
        center = model.box_centers[box] - body.center
        half = model.box_halves[box]
        middle = body.position + body.rotation * center
        # Grid points below the bounding sphere of the box.
        reach = wp.length(half)
        left = wp.max(int(wp.ceil((middle[0] - reach - scene.origin[0]) / scene.cell)), 0)
        right = wp.min(int(wp.floor((middle[0] + reach - scene.origin[0]) / scene.cell)), columns - 1)
        bottom = wp.max(int(wp.ceil((middle[1] - reach - scene.origin[1]) / scene.cell)), 0)
        top = wp.min(int(wp.floor((middle[1] + reach - scene.origin[1]) / scene.cell)), scene.heights.shape[0] - 1)
        for j in range(bottom, top + 1):
            for i in range(left, right + 1):
                x = scene.origin[0] + float(i) * scene.cell
                y = scene.origin[1] + float(j) * scene.cell
                peak = to_body * (wp.vec3(x, y, scene.heights[j, i]) - body.position)
                local = peak - center
                gap_x = wp.abs(local[0]) - half[0]
                gap_y = wp.abs(local[1]) - half[1]
                # The ground is solid below a peak, which therefore enters through the face that looks down.
                gap_z = -half[2] - upright * local[2]
                gap = wp.max(gap_x, wp.max(gap_y, gap_z))
                if gap < 0.0 and wp.abs(local[2]) < half[2]:
                    normal = wp.vec3(0.0, 0.0, upright)
                    if gap == gap_x:
                        normal = wp.vec3(-wp.sign(local[0]), 0.0, 0.0)
                    elif gap == gap_y:
                        normal = wp.vec3(0.0, -wp.sign(local[1]), 0.0)
                    # Keys: negative.
                    key = -1 - (j * columns + i)
                    count = add_contact(contacts, count, model, key, NO_WHEEL, peak, normal, gap, friction, AT_REST)
    return count


@wp.func
def collide_part(
    contacts: wp.array[Contact],
    count: int,
    scene: Scene,
    solid: int,
    part: int,
    body: Body,
    model: RobotModel,
    axles: wp.array[wp.vec3],
    friction: float,
    key: int,
    velocity: wp.vec3,
    turn: wp.vec3,
) -> int:
    """Adds a contact if a part (box or wheel) of the rover overlaps with a solid; returns the contact count.

    It is negative if they overlap: also if the array of contacts is full. ``body`` is in the frame of the scene. The
    solid turns at ``turn`` (rad/s) and would move at ``velocity`` (m/s) at the center of mass, both in the body frame.
    ``key`` identifies solid and part from step to step.
    """
    wheel = part - model.box_centers.shape[0]
    axle = LEFT
    if wheel >= 0:
        axle = axles[wheel]
    else:
        wheel = NO_WHEEL
    hit = find_overlap(scene, model, body, part, axle, solid)
    if hit.depth > 0.0:
        surface = velocity + wp.cross(turn, hit.arm)
        return -add_contact(contacts, count, model, key, wheel, hit.arm, hit.normal, -hit.depth, friction, surface)
    return count


@wp.func
def collide_with_obstacles(
    contacts: wp.array[Contact],
    count: int,
    scene: Scene,
    body: Body,
    model: RobotModel,
    axles: wp.array[wp.vec3],
    friction: float,
    pairs: wp.array[int],
    touched: wp.array[wp.bool],
    rover: int,
) -> int:
    """Adds a contact for each overlapping pair of a part (box or wheel) and an obstacle; returns the contact count.

    Sets ``touched[rover]`` if there is any. A uniform grid over (x, y) lists the obstacles near the rover, and bounding
    spheres and face planes reject most pairs. The others are collected in ``pairs``: neighboring threads of a GPU,
    which find theirs at different times, test them together.
    """
    if scene.grid_columns == 0:
        return count
    column = wp.clamp(int((body.position[0] - scene.grid_origin[0]) / scene.grid_cell), 0, scene.grid_columns - 1)
    row = wp.clamp(int((body.position[1] - scene.grid_origin[1]) / scene.grid_cell), 0, scene.grid_rows - 1)
    cell = row * scene.grid_columns + column
    parts = model.box_centers.shape[0] + model.wheels
    pair = scene.grid_starts[cell] * parts
    end = scene.grid_starts[cell + 1] * parts
    while pair < end:
        found = int(0)
        while pair < end and found < MAX_PAIRS:
            obstacle = scene.grid_obstacles[pair // parts]
            part = pair % parts
            step = int(1)
            if part == 0 and not is_near(scene, obstacle, body.position, model.bounding_radius):
                # None of the parts is near.
                step = parts
            else:
                middle = body.position + body.rotation * (part_center(model, part) - body.center)
                if is_near(scene, obstacle, middle, part_radius(model, part)):
                    # Also the key, above those of the chassis points.
                    pairs[found] = obstacle * parts + part
                    found += 1
            pair += step
        for k in range(found):
            solid = pairs[k] // parts
            key = OBSTACLE_KEYS + pairs[k]
            hit = collide_part(
                contacts, count, scene, solid, pairs[k] % parts, body, model, axles, friction, key, AT_REST, AT_REST
            )
            if hit < 0:
                touched[rover] = True
            count = wp.abs(hit)
    return count


@wp.func
def collide_with_movers(
    contacts: wp.array[Contact],
    count: int,
    forms: Scene,
    movers: MoverArrays,
    body: Body,
    model: RobotModel,
    axles: wp.array[wp.vec3],
    friction: float,
    rest: float,
    touched: wp.array[wp.bool],
    rover: int,
) -> int:
    """Adds a contact for each overlapping pair of a part of the rover and one of a mover; returns the contact count.

    Sets ``touched[rover]`` if there is any. A part of a mover is a solid in a frame that moves: with its position x and
    orientation q at this time, the pose of the rover in it is ``q^-1 (p - x)``, ``q^-1 R``. Its surface moves at
    ``v + w z x (c - x)`` at a point c. ``forms`` has the solids, each in its own frame. ``rest`` is the time from the
    start of this substep to the end of the control step, s.
    """
    parts = model.box_centers.shape[0] + model.wheels
    to_body = wp.transpose(body.rotation)
    local = Body()
    local.center = body.center
    for n in range(movers.form.shape[1]):
        form = movers.form[rover, n]
        if form < 0:
            continue
        velocity = movers.velocity[rover, n]
        place = movers.position[rover, n] - rest * velocity
        reach = forms.spheres[form][3] + model.bounding_radius
        if wp.length_sq(body.position - place) > reach * reach:
            continue
        turn = movers.turn[rover, n]
        frame = wp.quat_from_axis_angle(UP, -rest * turn) * movers.orientation[rover, n]
        local.position = wp.quat_rotate_inv(frame, body.position - place)
        local.rotation = wp.transpose(wp.quat_to_matrix(frame)) * body.rotation
        turning = turn * (to_body * UP)
        moving = to_body * velocity + wp.cross(turning, to_body * (body.position - place))
        for part in range(parts):
            middle = local.position + local.rotation * (part_center(model, part) - body.center)
            if is_near(forms, form, middle, part_radius(model, part)):
                # From 2^24, above those of the obstacles.
                key = MOVER_KEYS + n * parts + part
                hit = collide_part(
                    contacts, count, forms, form, part, local, model, axles, friction, key, moving, turning
                )
                if hit < 0:
                    touched[rover] = True
                count = wp.abs(hit)
    return count


@wp.func
def add_forces(forces: wp.array2d[float], rover: int, contacts: wp.array[Contact], first: int, count: int, rate: float):
    """Adds the normal impulses of obstacles and movers, times a rate (1/s), by the side of the rover that they act on.

    Columns: front, left, back and right for obstacles, then for movers. See ``sims.rover_state.by_side``.
    """
    for k in range(first, count):
        if contacts[k].key >= OBSTACLE_KEYS:
            side = wp.where(contacts[k].key >= MOVER_KEYS, 4, 0)
            push = rate * contacts[k].impulse[0] * contacts[k].direction
            forces[rover, side] += wp.max(-push[0], 0.0)
            forces[rover, side + 1] += wp.max(-push[1], 0.0)
            forces[rover, side + 2] += wp.max(push[0], 0.0)
            forces[rover, side + 3] += wp.max(push[1], 0.0)


@wp.func
def restore_impulses(
    contacts: wp.array[Contact], first: int, count: int, keys: wp.array[int], impulses: wp.array[wp.vec3]
):
    """Restores the impulses of the extra contacts, from index ``first`` on, by their keys (warm start).

    ``keys`` and ``impulses`` hold those of the last substep; ``keys`` is updated for the next one, 0 for no contact.
    """
    for k in range(first, count):
        for n in range(EXTRA_CONTACTS):
            if keys[n] == contacts[k].key:
                contacts[k].impulse = impulses[n]
    for n in range(EXTRA_CONTACTS):
        k = first + n
        if k < count:
            keys[n] = contacts[k].key
        else:
            keys[n] = 0
