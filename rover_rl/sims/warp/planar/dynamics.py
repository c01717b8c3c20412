"""Dynamics of a rover on level ground.

State: position of the center of mass, yaw, velocity and yaw rate. The solver works on ``u = (v_x, v_y, w)`` in the body
frame. The weight rests on the wheels as in the level stance, and each wheel touches the ground in one or two patches.
A patch with the load N slides with the slip ``s = (J_lon u - r W, J_lat u)`` between ground and a wheel of radius r
that turns at W, and feels Coulomb's friction of the magnitude ``mu N`` against s.

A substep of duration h is implicit: with the mass matrix M, it solves

    M (u - u_0) = -h sum_patches mu N J^T s(u) / max(|s(u)|, CREEP).

The right side is the gradient of the convex ``h sum mu N |s(u)|``. Iteratively reweighted least squares minimize
``(u - u_0) M (u - u_0) / 2`` plus that: in each iteration, a patch is a damper with the rate ``mu N / |s|`` of the last
iteration, and u follows from a linear system of three equations (E. Weiszfeld, 1937; D. Hunter and K. Lange, "A
tutorial on MM algorithms", 2004). No impulse is stored: iterations begin with the change of u in the last substep.

A motor holds the speed of its wheel within a torque limit T, which bounds the longitudinal force of a patch to its
share of ``T / r``. Then the wheel turns as fast as it rolls, and its inertia J adds ``J / r^2`` to the mass along it. A
wheel without a motor has no torque at all. Contacts with obstacles are stiff dampers along the normal that only push,
and friction.
"""

from __future__ import annotations

from rover_rl.native.warp import wp
from rover_rl.sims.warp.kernels.dynamics import GRAVITY, axle_of, write_base_state
from rover_rl.sims.warp.kernels.placing import set_at_rest
from rover_rl.sims.warp.kernels.types import MAX_WHEELS, RoverArrays
from rover_rl.sims.warp.planar.contacts import (
    MARGIN,
    MAX_MARGIN,
    MAX_TOUCHES,
    Outline,
    Touch,
    touch_movers,
    touch_obstacles,
    turned,
    unturned,
)
from rover_rl.sims.warp.planar.plan import Plan
from rover_rl.sims.warp.planar.robots import PlanarRobot
from rover_rl.worlds.movers.part_kernels import PartArrays

CREEP = 1.0e-3
"""Slip below which friction is in proportion to it, m/s."""
STIFF = 200.0
"""Inertia of a normal row, in masses of the rover: a push of one rover's weight yields by less than 1 mm/s."""
MAX_PATCHES = 2 * MAX_WHEELS
FASTEST_PART = 2.0
"""Speed of the fastest mover beyond which contacts may be found a step late, m/s."""


@wp.struct
class PlanarSolver:
    """Parameters of the solver: duration of a substep (s), substeps of a control step, iterations of a substep."""

    dt: float
    substeps: int
    iterations: int
    ground_friction: float
    obstacle_friction: float


@wp.struct
class Patch:
    """A patch of a tread: Jacobian rows along the wheel (or the axle of its roller) and across, and its friction.

    ``rim`` is the speed of the rim along the first row for each rad/s of the wheel, m, and ``speed`` that at the target
    of the motor, m/s; ``grip`` is ``h mu N`` and ``drive`` the largest impulse of the motor, N s; ``inertia`` is what
    the wheel adds to the mass as it rolls, kg. ``across`` is 0 for a roller, which nothing holds there.
    """

    ahead: wp.vec3
    left: wp.vec3
    rim: float
    speed: float
    grip: float
    drive: float
    inertia: float
    across: float


@wp.struct
class System:
    """Symmetric matrix ``A`` and right side ``b`` of three linear equations."""

    diagonal: wp.vec3
    # Entries (0, 1), (0, 2) and (1, 2).
    beside: wp.vec3
    right: wp.vec3


@wp.func
def with_row(system: System, row: wp.vec3, weight: float, speed: float) -> System:
    """Adds a damper between ``row . u`` and a speed: ``A += c J^T J``, ``b += c speed J^T``."""
    scaled = weight * row
    system.diagonal += wp.cw_mul(scaled, row)
    system.beside += wp.vec3(scaled[0] * row[1], scaled[0] * row[2], scaled[1] * row[2])
    system.right += speed * scaled
    return system


@wp.func
def solved(system: System) -> wp.vec3:
    """Solves the equations by cofactors; the matrix is positive definite."""
    a = system.diagonal
    b = system.beside
    c00 = a[1] * a[2] - b[2] * b[2]
    c01 = b[1] * b[2] - b[0] * a[2]
    c02 = b[0] * b[2] - a[1] * b[1]
    c11 = a[0] * a[2] - b[1] * b[1]
    c12 = b[0] * b[1] - a[0] * b[2]
    c22 = a[0] * a[1] - b[0] * b[0]
    scale = 1.0 / (a[0] * c00 + b[0] * c01 + b[1] * c02)
    r = system.right
    return scale * wp.vec3(
        c00 * r[0] + c01 * r[1] + c02 * r[2], c01 * r[0] + c11 * r[1] + c12 * r[2], c02 * r[0] + c12 * r[1] + c22 * r[2]
    )


@wp.func
def row_at(arm: wp.vec2, direction: wp.vec2) -> wp.vec3:
    """Jacobian row of a point along a direction: the speed is ``row . u``."""
    return wp.vec3(direction[0], direction[1], arm[0] * direction[1] - arm[1] * direction[0])


@wp.func
def prepare_patches(
    patches: wp.array[Patch], robot: PlanarRobot, axles: wp.array[wp.vec2], center: wp.vec2, rovers: RoverArrays,
    row: int, dt: float,
):  # fmt: skip
    """Fills in the patches of all wheels, for wheels that point along ``axles``."""
    share = 1.0 / float(robot.patches)
    for wheel in range(robot.model.wheels):
        ahead = axles[wheel]
        left = wp.vec2(-ahead[1], ahead[0])
        rim = robot.model.wheel_radius
        across = float(1.0)
        if robot.model.rollers.shape[0] > 0:
            roller = wp.vec2(robot.model.rollers[wheel][0], robot.model.rollers[wheel][1])
            if wp.length_sq(roller) > 0.0:
                # The rim moves along the wheel, and only the part of that along the roller's axle counts.
                along = wp.dot(roller, ahead)
                rim = rim * wp.where(wp.abs(along) > 1.0e-3, along, 1.0e-3)
                ahead = roller
                across = 0.0
        speed = float(0.0)
        drive = float(0.0)
        motor = robot.model.motor_of_wheel[wheel]
        if motor >= 0:
            speed = rim * rovers.target_speeds[row, motor]
            drive = dt * share * rovers.motor_torque[row] / wp.abs(rim)
        for n in range(robot.patches):
            side = wp.where(n == 0, robot.treads[wheel], -robot.treads[wheel])
            arm = robot.hubs[wheel] + side * left - center
            k = wheel * robot.patches + n
            patches[k].ahead = row_at(arm, ahead)
            patches[k].left = row_at(arm, left)
            patches[k].rim = rim
            patches[k].speed = speed
            patches[k].drive = drive
            patches[k].inertia = share * robot.model.wheel_inertia / (rim * rim)
            patches[k].across = across


@wp.func
def load_patches(patches: wp.array[Patch], robot: PlanarRobot, foot: wp.vec2, grip: float):
    """Sets the friction of all patches, of ``grip`` in all (N s), if the weight acts at ``foot`` in the base frame.

    With the friction that accelerates the rover at a, on the ground, and its center of mass at the height z above, the
    moments balance as if the weight acted at ``c - z a / g``: the zero-moment point.
    """
    for wheel in range(robot.model.wheels):
        load = robot.loads[wheel]
        share = wp.max(load[0] + load[1] * foot[0] + load[2] * foot[1], 0.0) / float(robot.patches)
        for n in range(robot.patches):
            patches[wheel * robot.patches + n].grip = grip * share


@wp.func
def with_friction(system: System, patch: Patch, start: wp.vec3, u: wp.vec3) -> System:
    """Adds the friction of a patch, with the slip at velocity ``u``, in a substep from velocity ``start``."""
    ahead = wp.dot(patch.ahead, u) - patch.speed
    left = patch.across * wp.dot(patch.left, u)
    slip = wp.max(wp.sqrt(ahead * ahead + left * left), CREEP)
    rate = patch.grip / slip
    rate_left = rate * patch.across
    if rate * wp.abs(ahead) > patch.drive:
        # The motor is too weak to make the wheel slip that much: what is left of the friction holds it sideways.
        rate = patch.drive / wp.max(wp.abs(ahead), CREEP)
        rest = wp.sqrt(wp.max(patch.grip * patch.grip - patch.drive * patch.drive, 0.0))
        rate_left = patch.across * rest / wp.max(wp.abs(left), CREEP)
        # The wheel speeds up with the rover.
        system = with_row(system, patch.ahead, patch.inertia, wp.dot(patch.ahead, start))
    system = with_row(system, patch.ahead, rate, patch.speed)
    return with_row(system, patch.left, rate_left, 0.0)


@wp.func
def with_touches(
    system: System, touches: wp.array[Touch], count: int, u: wp.vec3, stiffness: float, friction: float
) -> System:
    """Adds the contacts that push at velocity ``u``, and stores their normal impulses."""
    for k in range(count):
        normal = touches[k].normal
        push = stiffness * (touches[k].bias - wp.dot(normal, u))
        touches[k].impulse = wp.max(push, 0.0)
        if push > 0.0:
            system = with_row(system, normal, stiffness, touches[k].bias)
            slip = wp.max(wp.abs(wp.dot(touches[k].tangent, u) - touches[k].drift), CREEP)
            system = with_row(system, touches[k].tangent, friction * push / slip, touches[k].drift)
    return system


@wp.func
def solve(
    start: wp.vec3, guess: wp.vec3, patches: wp.array[Patch], robot: PlanarRobot, touches: wp.array[Touch], count: int,
    mass: wp.vec3, solver: PlanarSolver, friction: float,
) -> wp.vec3:  # fmt: skip
    """Velocity at the end of a substep, from that at its ``start`` and a first ``guess``."""
    own = System()
    own.diagonal = mass
    own.right = wp.cw_mul(mass, start)
    u = guess
    for _ in range(solver.iterations):
        system = own
        for k in range(robot.model.wheels * robot.patches):
            system = with_friction(system, patches[k], start, u)
        if count > 0:
            system = with_touches(system, touches, count, u, STIFF * mass[0], friction)
        u = solved(system)
    return u


@wp.func
def turn_wheels(patches: wp.array[Patch], robot: PlanarRobot, rovers: RoverArrays, row: int, u: wp.vec3):
    """Writes how fast the wheels turn: as their motors are told, or as they roll if these are too weak; rad/s."""
    for wheel in range(robot.model.wheels):
        first = wheel * robot.patches
        last = first + robot.patches - 1
        rolling = 0.5 * (wp.dot(patches[first].ahead, u) + wp.dot(patches[last].ahead, u))
        slip = wp.abs(rolling - patches[first].speed)
        across = wp.abs(wp.dot(patches[first].left, u)) * patches[first].across
        pull = patches[first].grip * slip / wp.max(wp.sqrt(slip * slip + across * across), CREEP)
        motor = robot.model.motor_of_wheel[wheel]
        rovers.wheel_spins[row, wheel] = rolling / patches[first].rim
        if motor >= 0 and pull <= patches[first].drive:
            rovers.wheel_spins[row, wheel] = rovers.target_speeds[row, motor]


@wp.func
def late_share(change: wp.vec3, mass: wp.vec3, grip: float) -> float:
    """Share of the change of velocity that a rover lacks on its way in a substep, as friction takes time for it.

    It takes the time ``t = |change| / (mu g)``, h at most, and the velocity lags by ``change t / (2 h)`` on average.
    """
    impulse = mass[0] * wp.sqrt(
        change[0] * change[0] + change[1] * change[1] + mass[2] / mass[0] * change[2] * change[2]
    )
    return 0.5 * wp.min(impulse / wp.max(grip, 1.0e-9), 1.0)


@wp.kernel
def step_planar(
    plans: wp.array[Plan],
    robots: wp.array[PlanarRobot],
    solver: PlanarSolver,
    rovers: RoverArrays,
    parts: PartArrays,
    first: int,
):
    """One control step; thread ``t`` simulates rover ``first + t``. Inactive rovers keep their state."""
    row = first + wp.tid()
    if not rovers.active[row]:
        return
    plan = plans[rovers.scene[row]]
    robot = robots[rovers.robot[row]]
    patches = wp.zeros(shape=(MAX_PATCHES,), dtype=Patch)
    touches = wp.zeros(shape=(MAX_TOUCHES,), dtype=Touch)
    axles = wp.zeros(shape=(MAX_WHEELS,), dtype=wp.vec2)
    dt = solver.dt
    center = wp.vec2(rovers.center[row][0], rovers.center[row][1])
    mass = wp.vec3(rovers.mass[row], rovers.mass[row], rovers.inertia[row][2, 2])
    position = wp.vec2(rovers.position[row][0], rovers.position[row][1])
    half_turn = wp.vec2(rovers.orientation[row][3], rovers.orientation[row][2])
    velocity = wp.vec2(rovers.velocity[row][0], rovers.velocity[row][1])
    rate = rovers.angular_velocity[row][2]
    change = wp.vec3(rovers.impulses[row, 0], rovers.impulses[row, 1], rovers.impulses[row, 2])
    grip = dt * rovers.friction_scale[row] * solver.ground_friction * rovers.mass[row] * GRAVITY
    # Height of the center of mass above the ground over g, for a change of the velocity in a substep, s.
    lever = (rovers.center[row][2] + robot.height) / (GRAVITY * dt)
    obstacle_friction = rovers.friction_scale[row] * solver.obstacle_friction
    outline = Outline()
    outline.row = row
    outline.center = center
    outline.rate = 1.0 / dt
    touched = bool(False)
    met = bool(False)
    for substep in range(solver.substeps):
        if substep == 0 or rovers.angles.shape[1] > 0:
            steer(axles, robot, rovers, row, float(substep + 1) / float(solver.substeps))
            prepare_patches(patches, robot, axles, center, rovers, row, dt)
        # cos and sin of the yaw from those of its half.
        ahead = wp.vec2(half_turn[0] * half_turn[0] - half_turn[1] * half_turn[1], 2.0 * half_turn[0] * half_turn[1])
        outline.position = position
        outline.ahead = ahead
        approach = wp.length(velocity) + wp.abs(rate) * robot.reach
        outline.margin = wp.min(MARGIN + dt * approach, MAX_MARGIN)
        count = touch_obstacles(touches, 0, plan, robot, axles, outline)
        if parts.kind.shape[1] > 0:
            outline.margin = wp.min(outline.margin + dt * FASTEST_PART, MAX_MARGIN)
            rest = float(solver.substeps - substep) * dt
            count = touch_movers(touches, count, plan.ground, robot, axles, outline, parts, rest)
        load_patches(patches, robot, center - lever * wp.vec2(change[0], change[1]), grip)
        local = unturned(velocity, ahead)
        start = wp.vec3(local[0], local[1], rate)
        u = solve(start, start + change, patches, robot, touches, count, mass, solver, obstacle_friction)
        change = u - start
        way = u - late_share(change, mass, grip) * change
        for k in range(count):
            if touches[k].impulse > 0.0 and wp.dot(touches[k].normal, u) <= touches[k].bias + CREEP:
                touched = True
                met = met or touches[k].of_mover
                # What stops a rover does so at once.
                way = u
        velocity = turned(wp.vec2(u[0], u[1]), ahead)
        rate = u[2]
        position += dt * turned(wp.vec2(way[0], way[1]), ahead)
        half = 0.5 * dt * way[2]
        half_turn = wp.normalize(turned(half_turn, wp.vec2(wp.cos(half), wp.sin(half))))
        if substep + 1 == solver.substeps:
            turn_wheels(patches, robot, rovers, row, u)
    rovers.contact[row] = touched
    rovers.mover_contact[row] = met
    rovers.position[row] = wp.vec3(position[0], position[1], rovers.position[row][2])
    rovers.orientation[row] = wp.quat(0.0, 0.0, half_turn[1], half_turn[0])
    rovers.velocity[row] = wp.vec3(velocity[0], velocity[1], 0.0)
    rovers.angular_velocity[row] = wp.vec3(0.0, 0.0, rate)
    for n in range(3):
        rovers.impulses[row, n] = change[n]
    for joint in range(rovers.angles.shape[1]):
        rovers.angles[row, joint] = rovers.target_angles[row, joint]
    write_base_state(robot.model, rovers, row)


@wp.func
def steer(axles: wp.array[wp.vec2], robot: PlanarRobot, rovers: RoverArrays, row: int, share: float):
    """Turns the wheels that steer, after a share of the control step."""
    for wheel in range(robot.model.wheels):
        axle = axle_of(robot.model, rovers, row, wheel, share)
        axles[wheel] = wp.vec2(axle[1], -axle[0])


@wp.kernel
def place_planar(plans: wp.array[Plan], robots: wp.array[PlanarRobot], rovers: RoverArrays, poses: wp.array[wp.vec3]):
    """Places the active rovers at planar poses, x, y (m) and yaw (rad), at rest."""
    row = wp.tid()
    if rovers.active[row]:
        robot = robots[rovers.robot[row]]
        pose = poses[row]
        orientation = wp.quat(0.0, 0.0, wp.sin(0.5 * pose[2]), wp.cos(0.5 * pose[2]))
        if orientation[3] < 0.0:
            orientation = -orientation
        base = wp.vec3(pose[0], pose[1], plans[rovers.scene[row]].ground + robot.height)
        set_at_rest(robot.model, rovers, row, wp.transform(base, orientation))
