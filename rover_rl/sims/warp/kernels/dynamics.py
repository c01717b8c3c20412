"""Rigid-body dynamics of a rover: constraint solver and time integration.

A rover is one rigid body with spinning wheels, whose centers of mass are on their axles: the inertia of the whole does
not depend on their angles, and motors and contacts are all that couples a wheel's spin to the body.

State (world frame unless stated otherwise): position of the center of mass (m), orientation quaternion (x, y, z, w),
velocity v (m/s), angular velocity w (rad/s), and the absolute spin rate s of each wheel about its axle (rad/s). The
solver works on v and w in the body frame, see :mod:`rover_rl.sims.warp.kernels.contacts` for the constraint rows.

A substep of duration h:

    1. Unconstrained velocity: ``v += h g``, ``w -= h I^-1 (w x (I w + J sum(s e)))`` (gyroscopic term, explicit).
    2. Collision detection, and preparation of the constraint rows.
    3. Warm start: apply the accumulated impulses of the last substep.
    4. Solver: sequential impulses, that is projected Gauss-Seidel on accumulated impulses with warm starting (E. Catto,
       "Iterative Dynamics with Temporal Coherence", GDC 2005). Each iteration passes over the normals, the friction and
       the motors.
    5. Integration: ``x += h v``, ``q += h/2 (w, 0) q``, normalized, with the new velocities (semi-implicit Euler).

Contacts are compliant: an implicit spring-damper with stiffness k and damping d, expressed by
``ERP = h k / (h k + d)`` and ``softness = 1 / (h (h k + d))`` (R. Smith, Open Dynamics Engine user guide, on ERP and
CFM). It makes the load on four wheels well defined.
"""

from __future__ import annotations

from rover_rl.native.warp import wp
from rover_rl.sims.scenes.scene import Scene
from rover_rl.sims.warp.kernels import contacts as contact
from rover_rl.sims.warp.kernels.contacts import EXTRA_CONTACTS, LEFT, MAX_CONTACTS, MAX_PAIRS, NO_WHEEL, Contact, Row
from rover_rl.sims.warp.kernels.types import MAX_WHEELS, Body, MoverArrays, RobotModel, RoverArrays, Solver

GRAVITY = 9.81
"""Gravitational acceleration, m/s^2."""


@wp.struct
class Twist:
    """Velocity of the center of mass (m/s) and angular velocity (rad/s), in the body frame, while the solver runs."""

    velocity: wp.vec3
    angular: wp.vec3


@wp.func_native("""
#if defined(__CUDA_ARCH__)
__syncthreads();
#endif
""")
def sync_threads():
    """Lets the threads of a block read the same instructions at the same time: they do not fit into a GPU's cache."""
    ...


@wp.func
def apply_impulse(
    twist: Twist,
    wheel_spins: wp.array[float],
    contacts: wp.array[Contact],
    k: int,
    impulse: wp.vec3,
    inverse_mass: float,
    inverse_spin: float,
) -> Twist:
    """Applies an impulse (normal, longitudinal, lateral; N s) at contact ``k``: ``u += M^-1 J^T p``."""
    normal = contacts[k].normal
    longitudinal = contacts[k].longitudinal
    lateral = contacts[k].lateral
    twist.velocity += inverse_mass * (
        impulse[0] * normal.direction + impulse[1] * longitudinal.direction + impulse[2] * lateral.direction
    )
    twist.angular += impulse[0] * normal.response + impulse[1] * longitudinal.response + impulse[2] * lateral.response
    wheel = contacts[k].wheel
    if wheel != NO_WHEEL:
        wheel_spins[wheel] += inverse_spin * (
            impulse[0] * normal.axle + impulse[1] * longitudinal.axle + impulse[2] * lateral.axle
        )
    return twist


@wp.func
def row_speed(twist: Twist, spin: float, row: Row) -> float:
    """Speed of the rover's contact point along a direction, m/s: the Jacobian row times the velocity, ``J u``."""
    return wp.dot(row.direction, twist.velocity) + wp.dot(row.moment, twist.angular) + row.axle * spin


@wp.func
def solve_motors(
    twist: Twist,
    wheel_spins: wp.array[float],
    motors: wp.array[float],
    model: RobotModel,
    axles: wp.array[wp.vec3],
    responses: wp.array[wp.vec3],
    inverse_spin: float,
    masses: wp.array[float],
    targets: wp.array[float],
    max_impulse: float,
) -> Twist:
    """One Gauss-Seidel pass over the motors: velocity control with a torque limit.

    A motor turns its wheels against the chassis. The row of a wheel with the axle e is ``s - e . w = target``, with
    effective mass ``1 / (1/J + e . I^-1 e)``, 0 without a motor; the accumulated impulse in ``motors`` is clamped to +-
    ``max_impulse``, the torque limit times dt. ``responses`` are ``I^-1 e``.
    """
    for wheel in range(model.wheels):
        speed = wheel_spins[wheel] - wp.dot(axles[wheel], twist.angular)
        before = motors[wheel]
        after = wp.clamp(before + masses[wheel] * (targets[wheel] - speed), -max_impulse, max_impulse)
        motors[wheel] = after
        # Equal and opposite: the wheel gains what the body loses.
        wheel_spins[wheel] += inverse_spin * (after - before)
        twist.angular -= (after - before) * responses[wheel]
    return twist


@wp.func
def solve_contacts(
    twist: Twist,
    wheel_spins: wp.array[float],
    contacts: wp.array[Contact],
    count: int,
    softness: float,
    inverse_mass: float,
    inverse_spin: float,
) -> Twist:
    """One Gauss-Seidel pass over the contacts: all normals first, then all friction.

    Normal row (no penetration, compliant): ``p_n <- max(p_n + m_n (bias - J_n u - softness p_n), 0)``.

    Friction rows (Coulomb, isotropic): the tangential impulse that would stop the slip,
    ``p_t <- p_t - m_t (J_lon u - v_lon, J_lat u - v_lat)`` with the velocity v of the other surface, is scaled back to
    the circle ``|p_t| <= mu p_n`` of the friction cone.
    """
    for k in range(count):
        if contacts[k].active == 1:
            wheel = contacts[k].wheel
            spin = float(0.0)
            if wheel != NO_WHEEL:
                spin = wheel_spins[wheel]
            row = contacts[k].normal
            speed = row_speed(twist, spin, row)
            before = contacts[k].impulse
            error = contacts[k].bias - speed - softness * before[0]
            after = wp.max(before[0] + contacts[k].normal_mass * error, 0.0)
            contacts[k].impulse = wp.vec3(after, before[1], before[2])
            change = after - before[0]
            twist.velocity += (inverse_mass * change) * row.direction
            twist.angular += change * row.response
            if wheel != NO_WHEEL:
                wheel_spins[wheel] += inverse_spin * change * row.axle
    for k in range(count):
        if contacts[k].active == 1:
            spin = float(0.0)
            if contacts[k].wheel != NO_WHEEL:
                spin = wheel_spins[contacts[k].wheel]
            before = contacts[k].impulse
            mass = contacts[k].tangent_mass
            drift = contacts[k].drift
            forward = row_speed(twist, spin, contacts[k].longitudinal)
            sideways = row_speed(twist, spin, contacts[k].lateral)
            longitudinal = before[1] - mass * (forward - drift[0])
            lateral = before[2] - mass * (sideways - drift[1])
            max_friction = contacts[k].friction * before[0]
            scale = wp.min(
                1.0, max_friction / wp.max(wp.sqrt(longitudinal * longitudinal + lateral * lateral), 1.0e-12)
            )
            contacts[k].impulse = wp.vec3(before[0], longitudinal * scale, lateral * scale)
            tangential = wp.vec3(0.0, longitudinal * scale - before[1], lateral * scale - before[2])
            twist = apply_impulse(twist, wheel_spins, contacts, k, tangential, inverse_mass, inverse_spin)
    return twist


@wp.kernel
def step_dynamics(
    scenes: wp.array[Scene],
    models: wp.array[RobotModel],
    solver: Solver,
    rovers: RoverArrays,
    forms: wp.array[Scene],
    movers: MoverArrays,
    first: int,
):
    """One control step; thread ``t`` simulates rover ``first + t``. Inactive rovers keep their state.

    Impulses of the wheel contacts and motors are stored for the next control step; extra contacts start from zero.
    """
    row = first + wp.tid()
    if not rovers.active[row]:
        return
    scene = scenes[rovers.scene[row]]
    model = models[rovers.robot[row]]
    wheels = model.wheels
    wheel_contacts = 2 * wheels
    # Working memory of the thread.
    contacts = wp.zeros(shape=(MAX_CONTACTS,), dtype=Contact)
    pairs = wp.zeros(shape=(MAX_PAIRS,), dtype=int)
    keys = wp.zeros(shape=(EXTRA_CONTACTS,), dtype=int)
    impulses = wp.zeros(shape=(EXTRA_CONTACTS,), dtype=wp.vec3)
    wheel_spins = wp.zeros(shape=(MAX_WHEELS,), dtype=float)
    motors = wp.zeros(shape=(MAX_WHEELS,), dtype=float)
    axles = wp.zeros(shape=(MAX_WHEELS,), dtype=wp.vec3)
    responses = wp.zeros(shape=(MAX_WHEELS,), dtype=wp.vec3)
    masses = wp.zeros(shape=(MAX_WHEELS,), dtype=float)
    targets = wp.zeros(shape=(MAX_WHEELS,), dtype=float)
    for wheel in range(wheels):
        wheel_spins[wheel] = rovers.wheel_spins[row, wheel]
        motors[wheel] = rovers.impulses[row, 3 * wheel_contacts + wheel]
    for k in range(wheel_contacts):
        contacts[k].impulse = wp.vec3(
            rovers.impulses[row, 3 * k], rovers.impulses[row, 3 * k + 1], rovers.impulses[row, 3 * k + 2]
        )

    body = Body()
    body.center = rovers.center[row]
    body.position = rovers.position[row]
    body.inverse_mass = 1.0 / rovers.mass[row]
    body.inverse_inertia = rovers.inverse_inertia[row]
    body.inverse_spin = 1.0 / model.wheel_inertia
    inertia = rovers.inertia[row]
    orientation = rovers.orientation[row]
    velocity = rovers.velocity[row]
    angular_velocity = rovers.angular_velocity[row]
    ground_friction = rovers.friction_scale[row] * solver.ground_friction
    obstacle_friction = rovers.friction_scale[row] * solver.obstacle_friction
    max_impulse = rovers.motor_torque[row] * solver.dt
    dt = solver.dt
    rovers.contact[row] = False
    rovers.mover_contact[row] = False
    clear_reports(rovers, row)
    # Turns a sum of impulses into the mean of their force over the control step, 1/s.
    mean = 1.0 / (float(solver.substeps) * dt)

    for wheel in range(wheels):
        motor = model.motor_of_wheel[wheel]
        if motor >= 0:
            targets[wheel] = rovers.target_speeds[row, motor]

    for substep in range(solver.substeps):
        if substep == 0 or rovers.angles.shape[1] > 0:
            for wheel in range(wheels):
                axle = axle_of(model, rovers, row, wheel, float(substep + 1) / float(solver.substeps))
                axles[wheel] = axle
                responses[wheel] = body.inverse_inertia * axle
                if model.motor_of_wheel[wheel] >= 0:
                    masses[wheel] = 1.0 / (body.inverse_spin + wp.dot(axle, responses[wheel]))

        # 1. Unconstrained velocity, in the body frame: gravity and the gyroscopic term.
        body.rotation = wp.quat_to_matrix(orientation)
        to_body = wp.transpose(body.rotation)
        body.velocity = to_body * (velocity + wp.vec3(0.0, 0.0, -GRAVITY * dt))
        body.angular_velocity = to_body * angular_velocity
        total_spin = wp.vec3(0.0, 0.0, 0.0)
        for wheel in range(wheels):
            total_spin += wheel_spins[wheel] * axles[wheel]
        momentum = inertia * body.angular_velocity + model.wheel_inertia * total_spin
        body.angular_velocity -= dt * (body.inverse_inertia * wp.cross(body.angular_velocity, momentum))

        # 2. Collision detection and constraint rows.
        sync_threads()
        contact.collide_wheels_with_ground(contacts, scene, body, model, solver, axles, ground_friction)
        count = wheel_contacts
        count = contact.collide_chassis_with_ground(contacts, count, scene, body, model, ground_friction)
        count = contact.collide_peaks_with_chassis(contacts, count, scene, body, model, ground_friction)
        sync_threads()
        count = contact.collide_with_obstacles(
            contacts, count, scene, body, model, axles, obstacle_friction, pairs, rovers.contact, row
        )
        if movers.form.shape[1] > 0:
            rest = float(solver.substeps - substep) * dt
            touched = rovers.mover_contact
            count = contact.collide_with_movers(
                contacts, count, forms[0], movers, body, model, axles, obstacle_friction, rest, touched, row
            )
        sync_threads()
        contact.prepare_contacts(contacts, count, body, model, solver, axles)
        contact.restore_impulses(contacts, wheel_contacts, count, keys, impulses)

        # 3. Warm start: few iterations suffice, since the impulses of the last substep are close to the solution.
        twist = Twist()
        twist.velocity = body.velocity
        twist.angular = body.angular_velocity
        for wheel in range(wheels):
            wheel_spins[wheel] += body.inverse_spin * motors[wheel]
            twist.angular -= motors[wheel] * responses[wheel]
        for k in range(count):
            if contacts[k].active == 1:
                twist = apply_impulse(
                    twist, wheel_spins, contacts, k, contacts[k].impulse, body.inverse_mass, body.inverse_spin
                )

        # 4. Solver iterations.
        sync_threads()
        for _iteration in range(solver.iterations):
            twist = solve_contacts(
                twist, wheel_spins, contacts, count, solver.softness, body.inverse_mass, body.inverse_spin
            )
            twist = solve_motors(
                twist, wheel_spins, motors, model, axles, responses, body.inverse_spin, masses, targets, max_impulse
            )
        for n in range(EXTRA_CONTACTS):
            impulses[n] = contacts[wheel_contacts + n].impulse
        if rovers.contact_force.shape[1] > 0:
            contact.add_forces(rovers.contact_force, row, contacts, wheel_contacts, count, mean)
        if rovers.wheel_torque.shape[1] > 0:
            for wheel in range(wheels):
                rovers.wheel_torque[row, wheel] += mean * motors[wheel]

        # 5. Integration, in the world frame.
        velocity = body.rotation * twist.velocity
        angular_velocity = body.rotation * twist.angular
        body.position = body.position + dt * velocity
        rate = wp.quat(angular_velocity[0], angular_velocity[1], angular_velocity[2], 0.0)
        orientation = wp.normalize(orientation + (0.5 * dt) * (rate * orientation))

    rovers.contact[row] = rovers.contact[row] or rovers.mover_contact[row]
    rovers.position[row] = body.position
    rovers.orientation[row] = orientation
    rovers.velocity[row] = velocity
    rovers.angular_velocity[row] = angular_velocity
    for wheel in range(wheels):
        rovers.wheel_spins[row, wheel] = wheel_spins[wheel]
        rovers.impulses[row, 3 * wheel_contacts + wheel] = motors[wheel]
    for k in range(wheel_contacts):
        for n in range(3):
            rovers.impulses[row, 3 * k + n] = contacts[k].impulse[n]
    for joint in range(rovers.angles.shape[1]):
        rovers.angles[row, joint] = rovers.target_angles[row, joint]
    write_base_state(model, rovers, row)


@wp.func
def clear_reports(rovers: RoverArrays, row: int):
    """Sets the forces and torques of a rover to zero, if they are asked for."""
    for n in range(rovers.contact_force.shape[1]):
        rovers.contact_force[row, n] = 0.0
    for n in range(rovers.wheel_torque.shape[1]):
        rovers.wheel_torque[row, n] = 0.0


@wp.func
def axle_of(model: RobotModel, rovers: RoverArrays, row: int, wheel: int, share: float) -> wp.vec3:
    """Direction of the axle of a wheel in the body frame, after a share of the control step."""
    joint = model.steering_of_wheel[wheel]
    if joint < 0:
        return LEFT
    before = rovers.angles[row, joint]
    angle = before + share * (rovers.target_angles[row, joint] - before)
    return wp.vec3(-wp.sin(angle), wp.cos(angle), 0.0)


@wp.func
def write_base_state(model: RobotModel, rovers: RoverArrays, row: int):
    """Writes the output of a rover: pose of the base frame, mean wheel speed of each motor, and steering angles.

    Wheel speeds are those that encoders measure, relative to the chassis: ``s - e . w`` for an axle e.
    """
    orientation = rovers.orientation[row]
    base = rovers.position[row] - wp.quat_rotate(orientation, rovers.center[row])
    rate = wp.quat_rotate_inv(orientation, rovers.angular_velocity[row])
    for n in range(3):
        rovers.base_state[row, n] = base[n]
    for n in range(4):
        rovers.base_state[row, 3 + n] = orientation[n]
    for motor in range(model.motors):
        total = float(0.0)
        count = float(0.0)
        for wheel in range(model.wheels):
            if model.motor_of_wheel[wheel] == motor:
                total += rovers.wheel_spins[row, wheel] - wp.dot(axle_of(model, rovers, row, wheel, 0.0), rate)
                count += 1.0
        rovers.base_state[row, 7 + motor] = total / count
    # Robots with fewer motors than others of the batch have their angles in the same columns.
    for joint in range(rovers.angles.shape[1]):
        rovers.base_state[row, 7 + rovers.target_speeds.shape[1] + joint] = rovers.angles[row, joint]
