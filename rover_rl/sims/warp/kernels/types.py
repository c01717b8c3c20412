"""Structs passed to the kernels: the robot model, the movers, the solver parameters and the rover state.

Units are SI: m, s, kg, rad, N m, N s. :mod:`rover_rl.sims.warp.kernels` defines the frames.
"""

from __future__ import annotations

from rover_rl.native.warp import wp

MAX_WHEELS = 6
"""Maximum number of wheels of a rover; sizes the arrays of a thread."""


@wp.struct
class RobotModel:
    """Geometry and wheel inertia of a robot. Positions in the base frame, m."""

    wheels: int
    # Motor of each wheel, -1 for a wheel without one; the steering joint that carries it, -1 without one; and the
    # direction of its roller on the ground, a unit vector, or zero for a tire.
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

    ``center`` is the center of mass in the base frame, ``position`` the same point in the world frame (m), ``rotation``
    the rotation from the body to the world frame. Velocities (m/s, rad/s) and inertia are in the body frame;
    ``inverse_spin`` is ``1 / J`` of a wheel.
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
    # Contact compliance, as an implicit spring-damper: share of the penetration removed in a substep (ODE's ERP),
    # approach speed admitted per unit of accumulated impulse, m/s per N s (ODE's CFM / dt), and the maximum speed at
    # which a penetration is removed, m/s.
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
    # Warm start [N, 7 * wheels], N s: normal, longitudinal and lateral impulse of the two ground contacts of each
    # wheel, then the angular impulse (N m s) of each motor.
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
    # Inputs: target speed of each motor relative to the chassis [N, motors] (rad/s), target angle of each steering
    # joint [N, steering] (rad), which rovers are simulated, and which of them scan.
    target_speeds: wp.array2d[float]
    target_angles: wp.array2d[float]
    active: wp.array[wp.bool]
    scanned: wp.array[wp.bool]
    # Outputs: base state [N, 7 + motors + steering] (position of the base frame, its orientation, mean speed of the
    # wheels of each motor relative to the chassis, angles), scan [N, beams], m, and whether the rover touched an
    # obstacle in the last control step.
    base_state: wp.array2d[float]
    ranges: wp.array2d[float]
    contact: wp.array[wp.bool]
    # Whether the rover touched a mover in the last control step.
    mover_contact: wp.array[wp.bool]
    # Outputs, empty unless asked for: forces on each side, of obstacles and of movers [N, 8], N, and torques of the
    # wheel motors [N, wheels], N m, means over the control step.
    contact_force: wp.array2d[float]
    wheel_torque: wp.array2d[float]
    # Working memory of the scan: bounds of how far each sector sees, [N, SECTORS], m.
    visible: wp.array2d[float]
