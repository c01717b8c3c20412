"""The rover's motion: one body with spinning wheels, driven by motors and held by contacts.

Impulses are found by projected Gauss-Seidel, from those of the substep before (E. Catto, "Iterative dynamics with
temporal coherence", GDC 2005). Wheels turn about their axles and have their centre of mass there, so that the inertia
of the whole does not depend on how far they have turned; motors and contacts couple their spins to the body.
"""

from __future__ import annotations

from rover_rl.sims.warp.kernels.contacts import (
    MAX_CONTACTS,
    MORE_CONTACTS,
    NO_WHEEL,
    Body,
    Contact,
    chassis_on_ground,
    ground_in_chassis,
    remembered,
    rover_at_obstacles,
    wheels_on_ground,
)
from rover_rl.sims.warp.kernels.types import MAX_WHEELS, Rover, Rovers, Scene, Solver
from rover_rl.sims.warp.library import wp

GRAVITY = 9.81


@wp.struct
class Motion:
    """Velocity of the centre of mass and angular velocity, in the rover's frame: all that impulses change of a body."""

    velocity: wp.vec3
    angular: wp.vec3


@wp.func
def push(
    motion: Motion,
    spins: wp.array[float],
    contacts: wp.array[Contact],
    k: int,
    impulse: wp.vec3,
    inverse_mass: float,
    inverse_spin: float,
) -> Motion:
    """The motion after an impulse at contact ``k``; the wheel's spin is changed in place."""
    motion.velocity += inverse_mass * (
        impulse[0] * contacts[k].normal + impulse[1] * contacts[k].ahead + impulse[2] * contacts[k].side
    )
    motion.angular += (
        impulse[0] * contacts[k].normal_turn + impulse[1] * contacts[k].ahead_turn + impulse[2] * contacts[k].side_turn
    )
    wheel = contacts[k].wheel
    if wheel != NO_WHEEL:
        spins[wheel] += inverse_spin * (
            impulse[0] * contacts[k].normal_spin
            + impulse[1] * contacts[k].ahead_spin
            + impulse[2] * contacts[k].side_spin
        )
    return motion


@wp.func
def speed_along(motion: Motion, spin: float, direction: wp.vec3, moment: wp.vec3, contact_spin: float) -> float:
    """Speed (m/s) of a contact's point of the rover along a direction."""
    return wp.dot(direction, motion.velocity) + wp.dot(moment, motion.angular) + contact_spin * spin


@wp.func
def drive_motors(
    motion: Motion,
    spins: wp.array[float],
    motors: wp.array[float],
    rover: Rover,
    turn: wp.vec3,
    inverse_spin: float,
    speeds: wp.vec2,
    most: float,
) -> Motion:
    """One pass over the motors: each holds its wheel's speed against the chassis with at most the impulse ``most``.

    ``turn`` is the angular velocity that a unit of moment about the axles gives the body.
    """
    mass = 1.0 / (inverse_spin + turn[1])
    for wheel in range(rover.wheels):
        speed = wp.where(wheel < rover.left_wheels, speeds[0], speeds[1])
        before = motors[wheel]
        after = wp.clamp(before + mass * (speed - (spins[wheel] - motion.angular[1])), -most, most)
        motors[wheel] = after
        spins[wheel] += inverse_spin * (after - before)
        motion.angular -= (after - before) * turn
    return motion


@wp.func
def hold_contacts(
    motion: Motion,
    spins: wp.array[float],
    contacts: wp.array[Contact],
    count: int,
    softness: float,
    inverse_mass: float,
    inverse_spin: float,
) -> Motion:
    """One pass over the contacts: none is approached, and friction is within its cone."""
    for k in range(count):
        if contacts[k].live == 1:
            wheel = contacts[k].wheel
            spin = float(0.0)
            if wheel != NO_WHEEL:
                spin = spins[wheel]
            speed = speed_along(motion, spin, contacts[k].normal, contacts[k].normal_moment, contacts[k].normal_spin)
            before = contacts[k].impulse
            lack = contacts[k].bias - speed - softness * before[0]
            after = wp.max(before[0] + contacts[k].normal_mass * lack, 0.0)
            contacts[k].impulse = wp.vec3(after, before[1], before[2])
            more = after - before[0]
            motion.velocity += (inverse_mass * more) * contacts[k].normal
            motion.angular += more * contacts[k].normal_turn
            if wheel != NO_WHEEL:
                spins[wheel] += inverse_spin * more * contacts[k].normal_spin
    for k in range(count):
        if contacts[k].live == 1:
            spin = float(0.0)
            if contacts[k].wheel != NO_WHEEL:
                spin = spins[contacts[k].wheel]
            before = contacts[k].impulse
            mass = contacts[k].tangent_mass
            ahead = before[1] - mass * speed_along(
                motion, spin, contacts[k].ahead, contacts[k].ahead_moment, contacts[k].ahead_spin
            )
            side = before[2] - mass * speed_along(
                motion, spin, contacts[k].side, contacts[k].side_moment, contacts[k].side_spin
            )
            most = contacts[k].friction * before[0]
            scale = wp.min(1.0, most / wp.max(wp.sqrt(ahead * ahead + side * side), 1.0e-12))
            contacts[k].impulse = wp.vec3(before[0], ahead * scale, side * scale)
            aside = wp.vec3(0.0, ahead * scale - before[1], side * scale - before[2])
            motion = push(motion, spins, contacts, k, aside, inverse_mass, inverse_spin)
    return motion


@wp.kernel
def step_dynamics(scene: Scene, rover: Rover, solver: Solver, rovers: Rovers, first: int):
    """One control step of the rovers from ``first`` on; those that are not active stay as they are."""
    row = first + wp.tid()
    if not rovers.active[row]:
        return
    wheels = rover.wheels
    own = 2 * wheels
    contacts = wp.zeros(shape=(MAX_CONTACTS,), dtype=Contact)
    keys = wp.zeros(shape=(MORE_CONTACTS,), dtype=int)
    impulses = wp.zeros(shape=(MORE_CONTACTS,), dtype=wp.vec3)
    spins = wp.zeros(shape=(MAX_WHEELS,), dtype=float)
    motors = wp.zeros(shape=(MAX_WHEELS,), dtype=float)
    for wheel in range(wheels):
        spins[wheel] = rovers.spins[row, wheel]
        motors[wheel] = rovers.impulses[row, 3 * own + wheel]
    for k in range(own):
        contacts[k].impulse = wp.vec3(
            rovers.impulses[row, 3 * k], rovers.impulses[row, 3 * k + 1], rovers.impulses[row, 3 * k + 2]
        )

    body = Body()
    body.center = rovers.center[row]
    body.position = rovers.position[row]
    body.inverse_mass = 1.0 / rovers.mass[row]
    body.inverse_inertia = rovers.inverse_inertia[row]
    body.inverse_spin = 1.0 / rover.wheel_inertia
    inertia = rovers.inertia[row]
    orientation = rovers.orientation[row]
    velocity = rovers.velocity[row]
    angular_velocity = rovers.angular_velocity[row]
    speeds = rovers.speeds[row]
    grip = rovers.grip[row]
    most = rovers.torque[row] * solver.dt
    dt = solver.dt

    for _ in range(solver.substeps):
        body.rotation = wp.quat_to_matrix(orientation)
        back = wp.transpose(body.rotation)
        body.velocity = back * (velocity + wp.vec3(0.0, 0.0, -GRAVITY * dt))
        body.angular_velocity = back * angular_velocity
        spinning = float(0.0)
        for wheel in range(wheels):
            spinning += spins[wheel]
        momentum = inertia * body.angular_velocity + wp.vec3(0.0, rover.wheel_inertia * spinning, 0.0)
        body.angular_velocity -= dt * (body.inverse_inertia * wp.cross(body.angular_velocity, momentum))

        wheels_on_ground(contacts, scene, body, rover, solver, grip * solver.ground_friction)
        count = own
        count = chassis_on_ground(contacts, count, scene, body, rover, solver, grip * solver.ground_friction)
        count = ground_in_chassis(contacts, count, scene, body, rover, solver, grip * solver.ground_friction)
        count = rover_at_obstacles(contacts, count, scene, body, rover, solver, grip * solver.obstacle_friction)
        remembered(contacts, own, count, keys, impulses)

        motion = Motion()
        motion.velocity = body.velocity
        motion.angular = body.angular_velocity
        # What held before is a good guess.
        turn = wp.vec3(body.inverse_inertia[0, 1], body.inverse_inertia[1, 1], body.inverse_inertia[2, 1])
        for wheel in range(wheels):
            spins[wheel] += body.inverse_spin * motors[wheel]
            motion.angular -= motors[wheel] * turn
        for k in range(count):
            if contacts[k].live == 1:
                motion = push(motion, spins, contacts, k, contacts[k].impulse, body.inverse_mass, body.inverse_spin)
        for _pass in range(solver.iterations):
            motion = hold_contacts(
                motion, spins, contacts, count, solver.softness, body.inverse_mass, body.inverse_spin
            )
            motion = drive_motors(motion, spins, motors, rover, turn, body.inverse_spin, speeds, most)
        for n in range(MORE_CONTACTS):
            impulses[n] = contacts[own + n].impulse

        velocity = body.rotation * motion.velocity
        angular_velocity = body.rotation * motion.angular
        body.position = body.position + dt * velocity
        spin = wp.quat(angular_velocity[0], angular_velocity[1], angular_velocity[2], 0.0)
        orientation = wp.normalize(orientation + (0.5 * dt) * (spin * orientation))

    rovers.position[row] = body.position
    rovers.orientation[row] = orientation
    rovers.velocity[row] = velocity
    rovers.angular_velocity[row] = angular_velocity
    for wheel in range(wheels):
        rovers.spins[row, wheel] = spins[wheel]
        rovers.impulses[row, 3 * own + wheel] = motors[wheel]
    for k in range(own):
        for n in range(3):
            rovers.impulses[row, 3 * k + n] = contacts[k].impulse[n]
    tell(rover, rovers, row)


@wp.func
def tell(rover: Rover, rovers: Rovers, row: int):
    """Writes what the task is told of a rover: base frame, and mean speeds of the left and the right wheels."""
    orientation = rovers.orientation[row]
    base = rovers.position[row] - wp.quat_rotate(orientation, rovers.center[row])
    pitching = wp.quat_rotate_inv(orientation, rovers.angular_velocity[row])[1]
    left = float(0.0)
    right = float(0.0)
    for wheel in range(rover.wheels):
        speed = rovers.spins[row, wheel] - pitching
        if wheel < rover.left_wheels:
            left += speed
        else:
            right += speed
    for n in range(3):
        rovers.body[row, n] = base[n]
    for n in range(4):
        rovers.body[row, 3 + n] = orientation[n]
    rovers.body[row, 7] = left / float(rover.left_wheels)
    rovers.body[row, 8] = right / float(rover.wheels - rover.left_wheels)


@wp.kernel
def place(rover: Rover, rovers: Rovers, poses: wp.array2d[float]):
    """Puts the active rovers at rest at poses of their base frames: position, then quaternion (x, y, z, w)."""
    row = wp.tid()
    if not rovers.active[row]:
        return
    orientation = wp.quat(poses[row, 3], poses[row, 4], poses[row, 5], poses[row, 6])
    base = wp.vec3(poses[row, 0], poses[row, 1], poses[row, 2])
    rovers.position[row] = base + wp.quat_rotate(orientation, rovers.center[row])
    rovers.orientation[row] = orientation
    rovers.velocity[row] = wp.vec3(0.0, 0.0, 0.0)
    rovers.angular_velocity[row] = wp.vec3(0.0, 0.0, 0.0)
    for n in range(rovers.spins.shape[1]):
        rovers.spins[row, n] = 0.0
    for n in range(rovers.impulses.shape[1]):
        rovers.impulses[row, n] = 0.0
    tell(rover, rovers, row)
