"""Structs passed to the kernels, in SI units and the frames of :mod:`rover_rl.sims.warp.kernels`."""

from __future__ import annotations

from rover_rl.native.warp import wp

MAX_WHEELS = 6
"""Maximum number of wheels of a rover; sizes the arrays of a thread."""


@wp.struct
class RobotModel:
    """Geometry and wheel inertia of a robot. Positions in the base frame, m."""

    wheels: int
    # Motor and steering joint of each wheel, or -1; direction of its roller on the ground, zero for a tire.
    motors: int
    motor_of_wheel: wp.array[int]
    steering_of_wheel: wp.array[int]
    rollers: wp.array[wp.vec3]
    wheel_radius: float
    wheel_half_width: float
    # Moment of inertia of one wheel about its axle, kg m^2.
    wheel_inertia: float
    hubs: wp.array[wp.vec3]
    # Chassis: boxes aligned with the base frame, and sample points on them that are tested against the ground.
    box_centers: wp.array[wp.vec3]
    box_halves: wp.array[wp.vec3]
    chassis_points: wp.array[wp.vec3]
    # Radius of a sphere around the center of mass that contains the rover, for any mass of the chassis.
    bounding_radius: float
    lidar_position: wp.vec3
    lidar_range: float


@wp.struct
class Body:
    """Pose, velocity and inertia of a rover in one substep.

    ``center`` is the center of mass in the base frame, ``position`` the same in the world frame, ``rotation`` that to
    the world frame. Velocities and inertia are in the body frame; ``inverse_spin`` is 1 / J of a wheel.
    """

    center: wp.vec3
    position: wp.vec3
    rotation: wp.mat33
    velocity: wp.vec3
    angular_velocity: wp.vec3
    inverse_mass: float
    inverse_inertia: wp.mat33
    inverse_spin: float


@wp.struct
class MoverArrays:
    """Parts of the movers of all rows, [N, P] each: see :class:`~rover_rl.worlds.movers.parts.Parts`."""

    # Index in the scene of forms, whose obstacles are the different solids, each in its own frame; -1 for none.
    form: wp.array2d[int]
    # Pose after the control step, and velocity (m/s) and yaw rate (rad/s) during it.
    position: wp.array2d[wp.vec3]
    orientation: wp.array2d[wp.quat]
    velocity: wp.array2d[wp.vec3]
    turn: wp.array2d[float]


@wp.struct
class Solver:
    """Parameters of the contact solver and the integrator."""

    # Duration of a substep (s), substeps of a control step, iterations of a substep.
    dt: float
    substeps: int
    iterations: int
    # Compliance of contacts: share of the penetration removed in a substep (ODE's ERP), approach speed per accumulated
    # impulse, m/s per N s (ODE's CFM / dt), and the maximum speed at which a penetration is removed, m/s.
    error_reduction: float
    softness: float
    max_correction: float
    # Gap above which a wheel contact is ignored, m.
    margin: float
    ground_friction: float
    obstacle_friction: float


@wp.struct
class RoverArrays:
    """State and parameters of all rovers, a row each. World frame unless stated otherwise."""

    # Center of mass of the whole rover (m), orientation of the base frame (x, y, z, w), velocity of the center of mass
    # (m/s) and angular velocity (rad/s).
    position: wp.array[wp.vec3]
    orientation: wp.array[wp.quat]
    velocity: wp.array[wp.vec3]
    angular_velocity: wp.array[wp.vec3]
    # Absolute spin rate of each wheel about its axle [N, wheels], rad/s: relative to the world, not to the chassis.
    wheel_spins: wp.array2d[float]
    # Warm start [N, 7 * wheels], N s: three impulses of the two ground contacts of each wheel, then that of each motor.
    impulses: wp.array2d[float]
    # Mass (kg), center of mass in the base frame (m), inertia about it in the body frame without the axle inertia of
    # the wheels (kg m^2), and the inverse of that.
    mass: wp.array[float]
    center: wp.array[wp.vec3]
    inertia: wp.array[wp.mat33]
    inverse_inertia: wp.array[wp.mat33]
    # Index of the rover's world in the array of scenes, and of its robot in the array of models.
    scene: wp.array[int]
    robot: wp.array[int]
    # Factor of all friction coefficients, and maximum torque of a wheel motor, N m.
    friction_scale: wp.array[float]
    motor_torque: wp.array[float]
    # Angle of each steering joint [N, steering], rad.
    angles: wp.array2d[float]
    # Inputs: targets of each motor [N, motors] (rad/s) and steering joint [N, steering] (rad), and who moves and scans.
    target_speeds: wp.array2d[float]
    target_angles: wp.array2d[float]
    active: wp.array[wp.bool]
    scanned: wp.array[wp.bool]
    # Outputs: base state [N, 7 + motors + steering] (pose of the base frame, mean speed of the wheels of each motor,
    # angles), scan [N, beams], m, and whether the rover touched anything, or a mover, in the last control step.
    base_state: wp.array2d[float]
    ranges: wp.array2d[float]
    contact: wp.array[wp.bool]
    mover_contact: wp.array[wp.bool]
    # Empty unless asked for: forces on each side [N, 8], N, and torques of the wheel motors [N, wheels], N m.
    contact_force: wp.array2d[float]
    wheel_torque: wp.array2d[float]
    # Working memory of the scan: bounds of how far each sector sees, [N, SECTORS], m.
    visible: wp.array2d[float]
