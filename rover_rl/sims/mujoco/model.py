"""MuJoCo model of a rover in a world, with contacts and motors that obey Coulomb's law.

:class:`~rover_rl.sims.mujoco.MujocoSettings` gives the reasons for the choices here.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Collection, Sequence
from typing import Any

import numpy as np

from rover_rl.native.mujoco import mujoco
from rover_rl.robots import Robot
from rover_rl.robots.shapes import Mass
from rover_rl.sims.mujoco import MujocoSettings
from rover_rl.sims.rover_state import Force
from rover_rl.worlds import Solids, World
from rover_rl.worlds.movers import Part

IMPEDANCE = 0.1
"""Constraint impedance of contacts: the share of the violation that a hard constraint would remove.

A low impedance makes a contact a spring and damper with a regularization that is large beside the inverse mass.
"""
SLIP_RATE = 150.0
"""Rate at which friction constraints correct the slip of a wheel, 1/s."""
FRICTION_HARDNESS = 1e5
"""Ratio of the regularization of normal to friction constraints (``impratio``); limits the creep at rest."""
MOTOR_IMPEDANCE = 0.9999
"""Constraint impedance of the motors, MuJoCo's maximum."""
MOTOR_RATE = 200.0
"""Rate at which the motors correct the speed of a wheel, 1/s."""
SHAFT_INERTIA = 1e4
"""Moment of inertia of a shaft, kg m^2. Its speed, set in each control step, changes by at most 0.1 mrad/s."""
STEERING_RATE = 2.0
"""Rate at which a steering joint turns to its target, per physics step: the fastest that is stable with a margin."""
STEERING_INERTIA = 1.5e-4
"""Least moment of inertia about a steering joint, kg m^2 per kg of the robot. With less, a joint at this rate would
give way to the friction of its wheel. Gears of real joints have that much."""
MAX_FELT = 16
"""Largest number of contacts with obstacles whose force is measured, and of those with movers."""
PART_INERTIA = 1e6
"""Inertia of a part along and about each axis, kg and kg m^2. A rover of 10 kg slows it by 10 um/s per m/s."""
LINK_SHARE = 1e-3
"""Mass and inertia of the link between a wheel and its steering or roller joint, relative to those of the wheel."""

_GROUND, _OBSTACLES = 1, 2
"""Collision groups, bits of ``contype`` of static geoms and of ``conaffinity`` of the rover's geoms."""
_AXLE = (math.sqrt(0.5), math.sqrt(0.5), 0.0, 0.0)
"""Rotation that turns a cylinder's axis from z to y, quaternion (w, x, y, z)."""
_HINGE = mujoco.mjtJoint.mjJNT_HINGE
_BODY = mujoco.mjtObj.mjOBJ_XBODY
GROUND_MARGIN = 3.0
"""Width of the ground for contacts beyond a world's bounds, m."""
BASE_THICKNESS = 1.0
"""Thickness of the ground below its lowest point, m."""
_QUARTER_TURN = (math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5))
"""Rotation by 90 degrees about the vertical, quaternion (w, x, y, z)."""


def make_model(
    robot: Robot, settings: MujocoSettings, world: World, parts: Sequence[Part] = (), reports: Collection[Force] = ()
) -> mujoco.MjModel:
    """Creates the model of one rover in a world, with ``parts`` of movers, which measures the fields ``reports``.

    The generalized coordinates are the pose of the base frame, the angles of the wheels, each after that of its
    steering or roller joint, and the angle of a shaft for each motor. The joints are ``"wheel 0"``, ``"roller 0"`` and
    ``"shaft 0"``, by the index of the wheel or motor, and the steering joints have their own names.

    A wheel with ideal rollers is a sphere on a free joint along the roller on the ground: it rolls freely across the
    axle of the roller, and is driven along it. ``RoverPhysics`` keeps that joint at zero, since a roller on the ground
    does not turn with the wheel.
    """
    spec = mujoco.MjSpec()
    _set_options(spec.option, settings)
    # The properties of static geoms apply to all contacts, as they have a higher priority than the rover's.
    static = {"condim": 3, "priority": 1, "conaffinity": 0}
    solid = {**static, "contype": _OBSTACLES, "friction": (settings.obstacle_friction, 0, 0)}
    add_ground(spec, world, contype=_GROUND, friction=(settings.ground_friction, 0, 0), **static)
    # A contact sensor tells obstacles from the ground by their body. It changes the order of the contacts, and with it
    # the last bits of a drive.
    body = spec.worldbody.add_body(name="obstacles") if "contact_force" in reports else spec.worldbody
    add_obstacles(spec, body, world, **solid)
    _add_rover(spec, robot, settings)
    _add_sensors(spec, bool(parts), reports, len(robot.drive.wheels))
    if parts:
        _add_parts(spec, parts, **solid)
    model = spec.compile()
    _scale_to_mass(model, settings)
    return model


def scaled_model(
    model: mujoco.MjModel, settings: MujocoSettings, friction: float, chassis_mass: float, motor_torque: float
) -> mujoco.MjModel:
    """Returns a copy of a model with other dynamics. See :class:`~rover_rl.sims.base.Dynamics` for the factors."""
    scaled = copy.copy(model)
    scaled.geom_friction[:] = friction * model.geom_friction
    scaled.pair_friction[:] = friction * model.pair_friction
    scaled.tendon_frictionloss[:] = motor_torque * model.tendon_frictionloss
    base = model.body("base").id
    scaled.body_mass[base] = chassis_mass * model.body_mass[base]
    scaled.body_inertia[base] = chassis_mass * model.body_inertia[base]
    mujoco.mj_setConst(scaled, mujoco.MjData(scaled))
    _scale_to_mass(scaled, settings)
    return scaled


def _set_options(option: Any, settings: MujocoSettings) -> None:
    option.timestep = settings.substep
    option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    option.solver = mujoco.mjtSolver.mjSOL_NEWTON
    option.iterations = settings.solver_iterations
    option.tolerance = settings.solver_tolerance
    option.impratio = FRICTION_HARDNESS


def _add_rover(spec: mujoco.MjSpec, robot: Robot, settings: MujocoSettings) -> None:
    base = spec.worldbody.add_body(name="base")
    base.add_freejoint()
    _set_inertia(base, robot.chassis)
    for box in robot.boxes:
        form = {"type": mujoco.mjtGeom.mjGEOM_BOX, "pos": box.center, "size": np.array(box.size) / 2}
        base.add_geom(condim=3, contype=0, conaffinity=_GROUND | _OBSTACLES, **form)
    shafts = [spec.worldbody.add_body(name=f"shaft {motor}") for motor in range(len(robot.drive.motors))]
    for shaft in shafts:
        _set_moments(shaft, 1.0, SHAFT_INERTIA, SHAFT_INERTIA)
    for index, motor in enumerate(robot.drive.motor_of_wheel):
        _add_wheel(spec, base, index, robot, settings)
        if motor >= 0:
            # Dry friction of at most the torque of the motor couples a wheel to the shaft.
            clutch = spec.add_tendon(name=f"motor {index}", frictionloss=robot.drive.torque)
            clutch.wrap_joint(f"wheel {index}", 1.0)
            clutch.wrap_joint(f"shaft {motor}", -1.0)
            clutch.solref_friction = _rate(MOTOR_RATE, MOTOR_IMPEDANCE)
            clutch.solimp_friction = _impedance(MOTOR_IMPEDANCE)
    # After the wheels, so that the order of the coordinates is that of make_model().
    for motor, shaft in enumerate(shafts):
        shaft.add_joint(name=f"shaft {motor}", type=_HINGE, axis=(0, 1, 0))


def _add_wheel(spec: mujoco.MjSpec, base: Any, index: int, robot: Robot, settings: MujocoSettings) -> None:
    """Adds a wheel, on a steering joint or on the free joint of its rollers if it has one.

    Its shapes are the full width for obstacles, and the tread for the ground.
    """
    parent, place, drive = base, {"pos": robot.wheels.hubs[index]}, robot.drive
    turn, spin, mass = robot.wheel.inertia[0][0], robot.wheel.inertia[1][1], robot.wheel.mass
    joint: dict[str, Any] = {}
    # The direction of the rollers, rad; None for a tire.
    roller = drive.rollers[index] if drive.rollers else None
    if robot.wheels.steering and robot.wheels.steering[index] >= 0:
        least = STEERING_INERTIA * robot.mass
        joint = {"name": drive.steering[robot.wheels.steering[index]], "axis": (0, 0, 1)}
        joint["armature"] = max(0.0, least - turn)
        _add_servo(spec, joint["name"], max(least, turn))
    elif roller is not None:
        joint = {"name": f"roller {index}", "axis": (math.cos(roller), math.sin(roller), 0)}
    if joint:
        parent = base.add_body(name=f"carrier {index}", **place)
        _set_moments(parent, LINK_SHARE * mass, LINK_SHARE * turn, LINK_SHARE * turn)
        parent.add_joint(type=_HINGE, **joint)
        place = {}
    wheel = parent.add_body(name=f"wheel {index}", **place)
    _set_moments(wheel, mass, turn, spin)
    wheel.add_joint(name=f"wheel {index}", type=_HINGE, axis=(0, 1, 0))
    radius, half = robot.wheels.radius, robot.wheels.width / 2
    cylinder = {"type": mujoco.mjtGeom.mjGEOM_CYLINDER, "quat": _AXLE, "condim": 3, "contype": 0}
    sphere = {"type": mujoco.mjtGeom.mjGEOM_SPHERE, "size": (radius, 0, 0), "condim": 3, "contype": 0}
    body, tread = ({**cylinder, "size": (radius, side, 0)} if half else sphere for side in (half, half / math.sqrt(3)))
    wheel.add_geom(conaffinity=_OBSTACLES, **body)
    wheel.add_geom(name=f"tread {index}", conaffinity=0, **(tread if roller is None else sphere))
    # Only explicit pairs have a reference of their own for friction.
    pair = {"name": f"tread {index}", "geomname1": "ground", "geomname2": f"tread {index}", "condim": 3}
    pair["friction"] = (settings.ground_friction, settings.ground_friction, 0, 0, 0)
    spec.add_pair(solimp=_impedance(IMPEDANCE), solreffriction=_rate(SLIP_RATE, IMPEDANCE), **pair)


def _add_servo(spec: mujoco.MjSpec, joint: str, inertia: float) -> None:
    """Adds the motor of a steering joint: a critically damped spring that pulls it to its target."""
    servo = spec.add_actuator(name=joint, target=joint, trntype=mujoco.mjtTrn.mjTRN_JOINT)
    servo.gaintype, servo.biastype = mujoco.mjtGain.mjGAIN_FIXED, mujoco.mjtBias.mjBIAS_AFFINE
    rate = STEERING_RATE / spec.option.timestep
    servo.gainprm[0] = inertia * rate**2
    servo.biasprm[1:3] = -inertia * rate**2, -2 * inertia * rate


def _set_moments(body: Any, mass: float, turn: float, spin: float) -> None:
    """Sets the mass of a body about its origin, with the moment of inertia ``spin`` about y and ``turn`` across."""
    _set_inertia(body, Mass.of(mass, np.zeros(3), np.diag((turn, spin, turn))))


def _set_inertia(body: Any, mass: Mass) -> None:
    body.explicitinertial = True
    body.mass, body.ipos = mass.mass, mass.center
    body.fullinertia = np.array(mass.inertia)[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]


def _add_sensors(spec: mujoco.MjSpec, with_movers: bool, reports: Collection[Force], wheels: int) -> None:
    """Adds sensors: the numbers of contacts of the rover, of those with the ground and with movers, and the reports.

    They do not act on the rover. With sensors, the states of a rollout come with the contacts of every physics step.
    """
    contact = {"type": mujoco.mjtSensor.mjSENS_CONTACT, "objtype": _BODY, "objname": "base"}
    field = mujoco.mjtConDataField
    # Data, a bit field; no reduction; number of contacts with data, which does not limit the number found.
    counted = (1 << field.mjCONDATA_FOUND.value, 0, 1)
    spec.add_sensor(name="contacts", intprm=counted, **contact)
    ground = {"reftype": mujoco.mjtObj.mjOBJ_GEOM, "refname": "ground"}
    spec.add_sensor(name="ground contacts", intprm=counted, **ground, **contact)
    if with_movers:
        spec.add_sensor(name="mover contacts", intprm=counted, reftype=_BODY, refname="movers", **contact)
    if "contact_force" in reports:
        # The strongest contacts with each body: force in the frame of the contact, along the normal first, and normal.
        felt = (1 << field.mjCONDATA_FORCE.value | 1 << field.mjCONDATA_NORMAL.value, 2, MAX_FELT)
        for body in ("obstacles", "movers")[: 1 + with_movers]:
            spec.add_sensor(name=f"force of {body}", intprm=felt, reftype=_BODY, refname=body, **contact)
    if "wheel_torque" in reports:
        # Between a wheel and what carries it, in the frame of the wheel, about whose axle only the motor acts.
        for name in (f"torque {wheel}" for wheel in range(wheels)):
            spec.body(name.replace("torque", "wheel")).add_site(name=name)
            site = {"objtype": mujoco.mjtObj.mjOBJ_SITE, "objname": name}
            spec.add_sensor(name=name, type=mujoco.mjtSensor.mjSENS_TORQUE, **site)


def _impedance(value: float) -> tuple[float, ...]:
    """Returns the ``solimp`` of a constant impedance."""
    return (value, value, 0.001, 0.5, 2.0)


def _rate(rate: float, impedance: float) -> tuple[float, float]:
    """Returns the ``solref`` of a friction constraint that corrects slip at a rate (1/s).

    Negative values state stiffness and damping; MuJoCo divides the damping by the impedance.
    """
    return (-1.0, -rate * impedance)


def _scale_to_mass(model: mujoco.MjModel, settings: MujocoSettings) -> None:
    """Sets what depends on the mass of the rover: stiffness and damping of contacts, and the scale of the tolerance.

    MuJoCo scales contacts by the mobility of the bodies. With the impedance d and the mobility A (1/kg), it regularizes
    a contact by R = A (1 - d) / d, and its force is (k d x + b v) / R, with k = stiffness / d^2 and b = damping / d for
    the penetration x, its rate v and ``solref = (-stiffness, -damping)`` (MuJoCo documentation, Computation, Constraint
    model). A wheel rests on two contacts.
    """
    wheels = [model.body(f"wheel {index}").id for index in range(model.npair)]
    mobility = (1 - IMPEDANCE) * model.body_invweight0[wheels, 0]
    reference = np.array((settings.stiffness / 2, settings.damping / 2))
    model.pair_solref[:] = -mobility[:, None] * reference
    model.geom_solref[:] = -mobility.mean() * reference
    model.geom_solimp[:] = _impedance(IMPEDANCE)
    # By default, the scale is the mass of the shafts.
    model.stat.meaninertia = model.body_subtreemass[model.body("base").id]


def _add_parts(spec: mujoco.MjSpec, slots: Sequence[Part], **options: Any) -> None:
    """Adds a body for each of the parts ``slots``, on a common body ``"movers"``, after all other joints.

    A body that MuJoCo moves from outside (``mocap``) has no velocity in contacts. These are on the joints ``"part 0
    x"``, ``"part 0 y"``, ``"part 0 z"`` and ``"part 0"``, and so on, with so much inertia that rovers do not push them:
    in a control step, they go on at the velocity that they have at the start. ``options`` are attributes of the geoms.
    """
    root = spec.worldbody.add_body(name="movers")
    kinds, joints = mujoco.mjtGeom, mujoco.mjtJoint
    for index, part in enumerate(slots):
        body = root.add_body(name=f"part {index}")
        # Gravity acts on the mass alone, which is small beside the inertia of the joints.
        body.explicitinertial, body.mass, body.inertia, body.gravcomp = True, 1.0, (1.0, 1.0, 1.0), 1.0
        for name, axis in zip("xyz", np.eye(3), strict=True):
            body.add_joint(name=f"part {index} {name}", type=joints.mjJNT_SLIDE, axis=axis, armature=PART_INERTIA)
        body.add_joint(name=f"part {index}", type=joints.mjJNT_BALL, armature=PART_INERTIA)
        length, width, height = (side / 2 for side in part.size)
        kind, size = {
            "box": (kinds.mjGEOM_BOX, (length, width, height)),
            "cylinder": (kinds.mjGEOM_CYLINDER, (length, height, 0)),
            "capsule": (kinds.mjGEOM_CAPSULE, (length, height - length, 0)),
        }[part.kind]
        body.add_geom(type=kind, size=size, **options)


def add_ground(spec: mujoco.MjSpec, world: World, **options: Any) -> None:
    """Adds the ground, ``"ground"``: an infinite plane if it is flat, else a height field with a margin.

    Outside the terrain, the height of its edge continues, as in :meth:`Terrain.height_at`. ``options`` are further
    attributes of the geom.
    """
    terrain = world.terrain
    if terrain.is_flat:
        height = terrain.heights[0, 0].item()
        plane = {"type": mujoco.mjtGeom.mjGEOM_PLANE, "pos": (0, 0, height), "size": (0, 0, 1)}
        spec.worldbody.add_geom(name="ground", **plane, **options)
        return
    ends = [
        (
            math.floor((low - GROUND_MARGIN - start) / terrain.cell),
            math.ceil((high + GROUND_MARGIN - start) / terrain.cell),
        )
        for (low, high), start in zip(world.bounds, terrain.origin, strict=True)
    ]
    columns, rows = (np.arange(first, last + 1) for first, last in ends)
    last_row, last_column = (count - 1 for count in terrain.heights.shape)
    heights = terrain.heights.double().numpy()[np.ix_(rows.clip(0, last_row), columns.clip(0, last_column))]
    lowest, rise = heights.min(), max(float(np.ptp(heights)), 1e-3)
    # MuJoCo splits cells along the diagonal (i, j)-(i + 1, j + 1), Terrain along the other one. Rotated by 90 degrees,
    # the diagonals agree: the height field's x axis is the world's y axis, and its y axis the world's negative x axis.
    data = heights.T[::-1]
    width, depth = ((axis[-1] - axis[0]) * terrain.cell for axis in (columns, rows))
    values, size = ((data - lowest) / rise).ravel().tolist(), (depth / 2, width / 2, rise, BASE_THICKNESS)
    spec.add_hfield(name="ground", nrow=data.shape[0], ncol=data.shape[1], size=size, userdata=values)
    x, y = (start + terrain.cell * (k[0] + k[-1]) / 2 for start, k in zip(terrain.origin, (columns, rows), strict=True))
    field = {"name": "ground", "hfieldname": "ground", "pos": (x, y, lowest), "quat": _QUARTER_TURN}
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_HFIELD, **field, **options)


def add_obstacles(spec: mujoco.MjSpec, body: Any, world: World, **options: Any) -> None:
    """Adds the obstacles to a body: boxes and convex meshes. ``options`` are further attributes of the geoms."""
    for index, obstacle in enumerate(world.obstacles):
        frame = _box_frame(obstacle)
        if frame is None:
            _add_mesh(spec, body, f"obstacle {index}", obstacle, **options)
            continue
        center, axes, half = frame
        quaternion = np.empty(4)
        mujoco.mju_mat2Quat(quaternion, axes.ravel())
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, pos=center, quat=quaternion, size=half, **options)


def _add_mesh(spec: mujoco.MjSpec, body: Any, name: str, solid: Solids, **options: Any) -> None:
    # Vertices relative to their center keep their precision, as MuJoCo stores them in single precision.
    vertices = solid.vertices.numpy()
    center = vertices.mean(0)
    points, triangles = (vertices - center).ravel().tolist(), solid.faces.flatten().tolist()
    inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
    spec.add_mesh(name=name, uservert=points, userface=triangles, inertia=inertia)
    body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name, pos=center, **options)


def _box_frame(obstacle: Solids) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """Returns the center ``[3]``, axes (columns) ``[3, 3]`` and the half extents ``[3]`` of a box, or ``None``."""
    corners, normals = obstacle.vertices.numpy(), obstacle.planes.numpy()[:, :3]
    if len(corners) != 8 or len(normals) != 6:
        return None
    center = corners.mean(0)
    first = normals[0]
    across = [normal for normal in normals if abs(normal @ first) < 1e-9]
    second = next(iter(across), first)
    axes = np.stack((first, second, np.cross(first, second)), 1)
    halves = np.abs((corners - center) @ axes)
    if len(across) != 4 or np.ptp(halves, axis=0).max() > 1e-9:
        return None
    return center, axes, halves.mean(0)
