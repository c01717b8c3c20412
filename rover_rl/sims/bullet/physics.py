"""Rigid-body physics of the rovers in one world, in Bullet."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from rover_rl.sims.bullet.contacts import NearObstacles, is_touching
from rover_rl.sims.bullet.geometry import add_ground, add_obstacles, friction_scales
from rover_rl.sims.bullet.settings import BulletSettings
from rover_rl.sims.bullet.urdf import bullet_urdf, roller_joint
from rover_rl.sims.native.bullet import pybullet
from rover_rl.sims.robots import Robot
from rover_rl.sims.worlds import World

ROVERS_PER_CLIENT = 64
"""Maximum number of rovers in a Bullet client.

More rovers no longer fit in the processor's cache and take two to three times as long each. The results do not depend
on this number.
"""

STEERING_TORQUE = 50.0
"""Maximum torque of a steering joint, N m: enough to turn a wheel on the spot."""
STEERING_GAIN = 0.5
"""Share of the remaining angle that a steering joint turns in a physics step."""

_CONJUGATE = np.array((-1.0, -1.0, -1.0, 1.0))

_STATIC, _ROVERS = 1, 2
"""Collision groups. Rovers collide with the world and not with one another."""


@dataclass(frozen=True)
class Reading:
    """Poses and joints of ``k`` rovers, as float64 arrays.

    Attributes:
        position: positions of the base frames, ``[k, 3]``, m.
        orientation: orientations of the base frames, quaternions (x, y, z, w), ``[k, 4]``.
        rotation: the orientations as matrices, ``[k, 3, 3]``. The columns are forward, left and up.
        joints: mean speed of the wheels of each motor (rad/s) and angle of each steering joint (rad), ``[k, M + S]``.
    """

    position: np.ndarray
    orientation: np.ndarray
    rotation: np.ndarray
    joints: np.ndarray


class RoverPhysics:
    """Physics of a number of rovers in one world. The rovers do not interact.

    Bullet states the pose of a body's inertial frame, whose origin is the center of mass and whose axes are the
    principal axes of inertia. The poses of this class are those of the base frame.

    Args:
        world: world of the rovers.
        robot: robot model.
        count: number of rovers.
        settings: settings of the physics.

    Attributes:
        clients: ids of the Bullet clients.
    """

    def __init__(self, world: World, robot: Robot, count: int, settings: BulletSettings) -> None:
        self._settings = settings
        self._friction_scales = friction_scales(settings.substeps)
        self.clients: list[int] = []
        self._grounds: list[list[int]] = []
        self._obstacles: list[list[int]] = []
        self._rovers: list[tuple[int, int]] = []
        for first in range(0, count, ROVERS_PER_CLIENT):
            client = connect(settings)
            self.clients.append(client)
            ground, obstacles = load_world(client, world, settings)
            self._grounds.append(ground)
            self._obstacles.append(obstacles)
            rovers = range(first, min(first + ROVERS_PER_CLIENT, count))
            with bullet_urdf(robot) as urdf:
                self._rovers += [(client, load_rover(client, urdf, settings)) for _ in rovers]
        self._near = NearObstacles(world.obstacles, *_bounding_box(*self._rovers[0]), settings.control_dt)
        drive, index = robot.drive, self._find_joints()
        self._motors = drive.motors
        self._wheels = [index[name] for motor in drive.motors for name in motor]
        self._steering = [index[name] for name in drive.steering]
        self._rollers = [index[roller_joint(name)] for name in drive.wheels] if drive.rollers else []
        passive = [index[name] for name in drive.passive]
        self._joints = [*self._wheels, *passive, *self._steering, *self._rollers]
        self._torque = drive.torque
        self._forces = [[self._torque] * len(self._wheels) for _ in range(count)]
        for rover in self._rovers:
            _release(*rover, [*passive, *self._rollers])
        client, body = self._rovers[0]
        info = pybullet.getDynamicsInfo(body, -1, physicsClientId=client)
        self._mass, self._inertia = info[0], np.array(info[2])
        self._inertial_position = np.array(info[3])
        self._inertial_orientation = np.array(info[4])

    def _find_joints(self) -> dict[str, int]:
        """Returns the indices of the joints of a rover, by name."""
        client, body = self._rovers[0]
        joints = range(pybullet.getNumJoints(body, physicsClientId=client))
        return {pybullet.getJointInfo(body, j, physicsClientId=client)[1].decode(): j for j in joints}

    def place(self, rows: Sequence[int], positions: np.ndarray, orientations: np.ndarray) -> None:
        """Places rovers at rest.

        Args:
            rows: indices of the rovers, k entries.
            positions: positions of the base frames, ``[k, 3]``, m.
            orientations: orientations of the base frames, quaternions (x, y, z, w), ``[k, 4]``.
        """
        inertial = _quaternion_products(orientations, self._inertial_orientation)
        centers = positions + (_rotation_matrices(orientations) * self._inertial_position).sum(-1)
        zeros, still = [0.0] * len(self._joints), [0.0] * len(self._wheels)
        ahead = [0.0] * len(self._steering)
        for row, center, orientation in zip(rows, centers.tolist(), inertial.tolist(), strict=True):
            self._restore(row, center, orientation, [0, 0, 0], [0, 0, 0], zeros, zeros)
            self._set_motors(row, still, ahead)
            _clear_contacts(*self._rovers[row])

    def set_dynamics(self, row: int, friction: float, chassis_mass: float, motor_torque: float) -> None:
        """Scales the dynamics of one rover relative to its description. See :class:`~rover_rl.sims.base.Dynamics`."""
        client, body = self._rovers[row]
        for link in range(-1, pybullet.getNumJoints(body, physicsClientId=client)):
            _set_contact(client, body, link, friction, self._settings)
        pybullet.changeDynamics(
            body,
            -1,
            mass=self._mass * chassis_mass,
            localInertiaDiagonal=(self._inertia * chassis_mass).tolist(),
            physicsClientId=client,
        )
        self._forces[row] = [self._torque * motor_torque] * len(self._wheels)

    def step(
        self, speeds: list[list[float]], angles: list[list[float]], poses: np.ndarray, held: Sequence[int] = ()
    ) -> np.ndarray:
        """Advances the world by one control step.

        Args:
            speeds: speed of each motor (rad/s) of every rover.
            angles: angle of each steering joint (rad) of every rover.
            poses: positions (m) and orientations (x, y, z, w) of the base frames before the step, ``[count, 7]``.
            held: rows for which no time passes. Their states are restored after the step.

        Returns:
            Whether each rover touched an obstacle in any of the physics steps, bool ``[count]``.
        """
        before = [self._snapshot(row) for row in held]
        counts = [len(motor) for motor in self._motors]
        for row, turning in enumerate(speeds):
            targets = [speed for speed, count in zip(turning, counts, strict=True) for _ in range(count)]
            self._set_motors(row, targets, angles[row])
        near = self._near.find(poses[:, :3].astype(float), _rotation_matrices(poses[:, 3:].astype(float)))
        touched = np.zeros(len(speeds), dtype=bool)
        for number, client in enumerate(self.clients):
            pairs = [(row, obstacle) for row, obstacle in near if row // ROVERS_PER_CLIENT == number]
            for scales in self._friction_scales:
                for ground in self._grounds[number]:
                    pybullet.changeDynamics(ground, -1, anisotropicFriction=scales, physicsClientId=client)
                pybullet.stepSimulation(physicsClientId=client)
                self._straighten_rollers(number)
                for row, obstacle in pairs:
                    if not touched[row]:
                        touched[row] = is_touching(*self._rovers[row], self._obstacles[number][obstacle])
        for row, snapshot in zip(held, before, strict=True):
            self._restore(row, *snapshot)
        return touched

    def read(self, rows: Sequence[int]) -> Reading:
        """Returns the poses and joints of the given rovers."""
        poses: list[float] = []
        speeds: list[float] = []
        angles: list[float] = []
        wheels, steering = self._wheels, self._steering
        for row in rows:
            client, body = self._rovers[row]
            # Keyword arguments would take longer than the calls themselves. The last argument is the client.
            position, orientation = pybullet.getBasePositionAndOrientation(body, client)
            poses += position
            poses += orientation
            speeds += [joint[1] for joint in pybullet.getJointStates(body, wheels, client)]
            if steering:
                angles += [joint[0] for joint in pybullet.getJointStates(body, steering, client)]
        pose = np.array(poses).reshape(-1, 7)
        wheel = np.array(speeds).reshape(len(pose), -1)
        orientation = _quaternion_products(pose[:, 3:], self._inertial_orientation * _CONJUGATE)
        rotation = _rotation_matrices(orientation)
        ends = np.cumsum([0, *map(len, self._motors)])
        motors = [wheel[:, first:last].mean(1) for first, last in pairwise(ends)]
        return Reading(
            position=pose[:, :3] - (rotation * self._inertial_position).sum(-1),
            orientation=orientation,
            rotation=rotation,
            joints=np.concatenate((np.stack(motors, 1), np.array(angles).reshape(len(pose), -1)), 1),
        )

    def _set_motors(self, row: int, speeds: list[float], angles: list[float]) -> None:
        client, body = self._rovers[row]
        pybullet.setJointMotorControlArray(
            body,
            self._wheels,
            pybullet.VELOCITY_CONTROL,
            targetVelocities=speeds,
            forces=self._forces[row],
            physicsClientId=client,
        )
        if angles:
            pybullet.setJointMotorControlArray(
                body,
                self._steering,
                pybullet.POSITION_CONTROL,
                targetPositions=angles,
                forces=[STEERING_TORQUE] * len(angles),
                positionGains=[STEERING_GAIN] * len(angles),
                velocityGains=[1.0] * len(angles),
                physicsClientId=client,
            )

    def _straighten_rollers(self, number: int) -> None:
        """Turns the rollers of the rovers in a client back, so that they keep their direction and speed."""
        if not self._rollers:
            return
        first = number * ROVERS_PER_CLIENT
        for client, body in self._rovers[first : first + ROVERS_PER_CLIENT]:
            for joint, state in zip(self._rollers, pybullet.getJointStates(body, self._rollers, client), strict=True):
                angle = -0.5 * self._settings.substep * state[1]
                pybullet.resetJointState(body, joint, angle, state[1], physicsClientId=client)

    def _snapshot(self, row: int) -> tuple:
        client, body = self._rovers[row]
        joints = pybullet.getJointStates(body, self._joints, physicsClientId=client)
        return (
            *pybullet.getBasePositionAndOrientation(body, physicsClientId=client),
            *pybullet.getBaseVelocity(body, physicsClientId=client),
            [joint[0] for joint in joints],
            [joint[1] for joint in joints],
        )

    def _restore(self, row, position, orientation, velocity, spin, angles, speeds) -> None:
        client, body = self._rovers[row]
        pybullet.resetBasePositionAndOrientation(body, position, orientation, physicsClientId=client)
        pybullet.resetBaseVelocity(body, velocity, spin, physicsClientId=client)
        for joint, angle, speed in zip(self._joints, angles, speeds, strict=True):
            pybullet.resetJointState(body, joint, angle, speed, physicsClientId=client)


def connect(settings: BulletSettings) -> int:
    """Creates an empty Bullet client with gravity and the given settings. Returns its id."""
    client = pybullet.connect(pybullet.DIRECT)
    pybullet.setGravity(0, 0, -9.81, physicsClientId=client)
    pybullet.setPhysicsEngineParameter(
        fixedTimeStep=settings.substep,
        numSolverIterations=settings.solver_iterations,
        solverResidualThreshold=settings.solver_residual,
        # Bullet's implicit friction cone rotates friction away from the slip, which halves the yaw rate of a
        # skid-steer rover.
        enableConeFriction=0,
        # Keeps the order of contacts the same in every run and batch.
        deterministicOverlappingPairs=1,
        physicsClientId=client,
    )
    return client


def load_world(client: int, world: World, settings: BulletSettings) -> tuple[list[int], list[int]]:
    """Adds the collision bodies of a world. Returns the ids of the ground's bodies and of the obstacles."""
    ground = add_ground(client, world)
    obstacles = add_obstacles(client, world.obstacles)
    frictions = dict.fromkeys(ground, settings.ground_friction)
    frictions |= dict.fromkeys(obstacles, settings.obstacle_friction)
    for body, friction in frictions.items():
        _set_contact(client, body, -1, friction, settings)
        pybullet.setCollisionFilterGroupMask(body, -1, _STATIC, _ROVERS, physicsClientId=client)
    for body in ground:
        pybullet.changeDynamics(
            body,
            -1,
            contactStiffness=settings.ground_stiffness,
            contactDamping=settings.ground_damping,
            physicsClientId=client,
        )
    return ground, obstacles


def load_rover(client: int, urdf: Path, settings: BulletSettings) -> int:
    """Loads a rover without damping and sleeping. Returns the id of its body.

    Raises:
        ValueError: if a link of the robot description has several collision shapes.
    """
    flags = pybullet.URDF_USE_INERTIA_FROM_FILE | pybullet.URDF_USE_IMPLICIT_CYLINDER
    body = pybullet.loadURDF(str(urdf), flags=flags | pybullet.URDF_IGNORE_VISUAL_SHAPES, physicsClientId=client)
    for link in range(-1, pybullet.getNumJoints(body, physicsClientId=client)):
        # Bullet sorts contacts by link. The order of a link's contacts would depend on the other rovers.
        if (shapes := len(pybullet.getCollisionShapeData(body, link, physicsClientId=client))) > 1:
            raise ValueError(f"{urdf}: a link may have one collision shape, link {link} has {shapes}")
        pybullet.changeDynamics(
            body,
            link,
            linearDamping=0.0,
            angularDamping=0.0,
            jointDamping=0.0,
            activationState=pybullet.ACTIVATION_STATE_DISABLE_SLEEPING,
            physicsClientId=client,
        )
        # In the call above, the friction would not apply to the wheels.
        _set_contact(client, body, link, 1.0, settings)
    _clear_contacts(client, body)
    return body


def _release(client: int, body: int, joints: Sequence[int]) -> None:
    """Lets joints turn freely. Bullet holds a joint without a command."""
    for joint in joints:
        pybullet.setJointMotorControl2(body, joint, pybullet.VELOCITY_CONTROL, force=0.0, physicsClientId=client)


def _bounding_box(client: int, body: int) -> tuple[np.ndarray, np.ndarray]:
    """Returns the lower and upper corner ``[3]`` (m) of a new rover in its base frame, which is that of the world."""
    links = range(-1, pybullet.getNumJoints(body, physicsClientId=client))
    low, high = np.array([pybullet.getAABB(body, link, physicsClientId=client) for link in links]).transpose(1, 0, 2)
    return low.min(0), high.max(0)


def _set_contact(client: int, body: int, link: int, friction: float, settings: BulletSettings) -> None:
    """Sets the friction coefficient of a link. Bullet multiplies the coefficients of two bodies in contact."""
    pybullet.changeDynamics(
        body,
        link,
        lateralFriction=friction,
        contactProcessingThreshold=settings.contact_threshold,
        physicsClientId=client,
    )


def _clear_contacts(client: int, body: int) -> None:
    """Removes a rover's contacts, which Bullet would keep over a reset to a nearby pose."""
    for link in range(-1, pybullet.getNumJoints(body, physicsClientId=client)):
        # Setting the filter, even to its current value, makes Bullet recompute the link's overlapping pairs.
        pybullet.setCollisionFilterGroupMask(body, link, _ROVERS, _STATIC, physicsClientId=client)


def _quaternion_products(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Multiplies quaternions ``a`` ``[k, 4]`` by one quaternion ``b`` ``[4]`` from the right, (x, y, z, w)."""
    x, y, z, w = b
    # The product is linear in a.
    matrix = np.array([[w, z, -y, x], [-z, w, x, y], [y, -x, w, z], [-x, -y, -z, w]])
    return (a[:, None, :] * matrix).sum(-1)


def _rotation_matrices(quaternions: np.ndarray) -> np.ndarray:
    """Returns rotation matrices ``[k, 3, 3]`` of unit quaternions ``[k, 4]``."""
    products = quaternions[:, :, None] * quaternions[:, None, :]
    return (products.reshape(-1, 1, 16) * _ROTATION).sum(-1).reshape(-1, 3, 3)


def _rotation_forms() -> np.ndarray:
    """Coefficients of each entry of a rotation matrix, row by row, in the quaternion's products: ``[9, 16]``."""
    x, y, z, w = np.eye(4)
    xx, yy, zz, ww = (np.outer(a, a) for a in (x, y, z, w))
    xy, xz, yz, xw, yw, zw = (2 * np.outer(*pair) for pair in ((x, y), (x, z), (y, z), (x, w), (y, w), (z, w)))
    forms = (
        (ww + xx - yy - zz, xy - zw, xz + yw),
        (xy + zw, ww - xx + yy - zz, yz - xw),
        (xz - yw, yz + xw, ww - xx - yy + zz),
    )
    return np.array(forms).reshape(9, 16)


_ROTATION = _rotation_forms()
