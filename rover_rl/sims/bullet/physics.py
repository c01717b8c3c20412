"""Many rovers on one static world, in one Bullet client."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rover_rl.sims.bullet.geometry import FRICTION_AXES, add_ground, add_obstacles
from rover_rl.sims.bullet.settings import BulletSettings
from rover_rl.sims.native.bullet import pybullet
from rover_rl.sims.robots import Robot
from rover_rl.sims.worlds import World

ROVERS_PER_CLIENT = 64
"""Rovers that share a Bullet client. More of them no longer fit in the processor's cache together, and cost two to
three times as much each; company changes nothing else."""

_CONJUGATE = np.array((-1.0, -1.0, -1.0, 1.0))

_STATIC, _ROVERS = 1, 2
"""Collision groups: rovers touch the world and pass through one another."""


@dataclass(frozen=True)
class Reading:
    """Where rovers are and how their wheels turn: float64 arrays of ``k`` rows.

    Attributes:
        position: of the base frame, ``[k, 3]``, m.
        orientation: of the base frame, ``[k, 4]``, quaternion (x, y, z, w).
        rotation: the same as a matrix, ``[k, 3, 3]``; columns are forward, left, up.
        wheel_speeds: mean of the left and of the right wheels, ``[k, 2]``, rad/s.
    """

    position: np.ndarray
    orientation: np.ndarray
    rotation: np.ndarray
    wheel_speeds: np.ndarray


class RoverPhysics:
    """Steps ``count`` rovers in a world of their own; each behaves as if it were alone.

    Bullet speaks of a body's inertial frame, which sits in the centre of mass and is turned to the principal axes of
    inertia; here all poses are those of the base frame.

    Args:
        world: where they are.
        robot: what they are.
        count: how many.
        settings: of the physics.

    Attributes:
        clients: the Bullet clients that the rovers are in.
    """

    def __init__(self, world: World, robot: Robot, count: int, settings: BulletSettings) -> None:
        self._settings = settings
        self.clients: list[int] = []
        self._grounds: list[list[int]] = []
        self._rovers: list[tuple[int, int]] = []
        for first in range(0, count, ROVERS_PER_CLIENT):
            client = connect(settings)
            self.clients.append(client)
            self._grounds.append(load_world(client, world, settings))
            rovers = range(first, min(first + ROVERS_PER_CLIENT, count))
            self._rovers += [(client, load_rover(client, robot, settings)) for _ in rovers]
        self._wheels = self._find_wheels(robot)
        self._torque = robot.wheel_torque
        self._forces = [[self._torque] * len(self._wheels) for _ in range(count)]
        self._sides = len(robot.left_wheels), len(robot.right_wheels)
        client, body = self._rovers[0]
        info = pybullet.getDynamicsInfo(body, -1, physicsClientId=client)
        self._mass, self._inertia = info[0], np.array(info[2])
        self._inertial_position = np.array(info[3])
        self._inertial_orientation = np.array(info[4])

    def _find_wheels(self, robot: Robot) -> list[int]:
        client, body = self._rovers[0]
        joints = range(pybullet.getNumJoints(body, physicsClientId=client))
        index = {pybullet.getJointInfo(body, j, physicsClientId=client)[1].decode(): j for j in joints}
        return [index[name] for name in (*robot.left_wheels, *robot.right_wheels)]

    def place(self, rows: Sequence[int], positions: np.ndarray, orientations: np.ndarray) -> None:
        """Puts rovers at rest at poses of their base frames: ``positions [k, 3]``, ``orientations [k, 4]``."""
        inertial = _times(orientations, self._inertial_orientation)
        centers = positions + (_matrix(orientations) * self._inertial_position).sum(-1)
        still = [0.0] * len(self._wheels)
        for row, center, orientation in zip(rows, centers.tolist(), inertial.tolist(), strict=True):
            self._restore(row, center, orientation, [0, 0, 0], [0, 0, 0], still, still)
            self._drive(row, still)
            _forget_contacts(*self._rovers[row])

    def set_dynamics(self, row: int, friction: float, chassis_mass: float, motor_torque: float) -> None:
        """Multiplies what a rover is by its description with these factors."""
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

    def step(self, speeds: list[list[float]], held: Sequence[int] = ()) -> None:
        """Steps the world through one control step.

        Args:
            speeds: left and right wheel speed (rad/s) of every rover.
            held: rows for which no time passes: they are put back to where they were.
        """
        left, right = self._sides
        before = [self._snapshot(row) for row in held]
        for row, (left_speed, right_speed) in enumerate(speeds):
            self._drive(row, [left_speed] * left + [right_speed] * right)
        for client, grounds in zip(self.clients, self._grounds, strict=True):
            for substep in range(self._settings.substeps):
                for ground in grounds:
                    pybullet.changeDynamics(
                        ground, -1, anisotropicFriction=FRICTION_AXES[substep % 2], physicsClientId=client
                    )
                pybullet.stepSimulation(physicsClientId=client)
        for row, snapshot in zip(held, before, strict=True):
            self._restore(row, *snapshot)

    def read(self, rows: Sequence[int]) -> Reading:
        """Reads the rovers of ``rows``."""
        poses: list[float] = []
        speeds: list[float] = []
        wheels = self._wheels
        for row in rows:
            client, body = self._rovers[row]
            # Keyword arguments cost more than the calls; these are by position, the client last.
            position, orientation = pybullet.getBasePositionAndOrientation(body, client)
            poses += position
            poses += orientation
            speeds += [joint[1] for joint in pybullet.getJointStates(body, wheels, client)]
        pose = np.array(poses).reshape(-1, 7)
        wheel = np.array(speeds).reshape(len(pose), -1)
        orientation = _times(pose[:, 3:], self._inertial_orientation * _CONJUGATE)
        rotation = _matrix(orientation)
        left = self._sides[0]
        return Reading(
            position=pose[:, :3] - (rotation * self._inertial_position).sum(-1),
            orientation=orientation,
            rotation=rotation,
            wheel_speeds=np.stack((wheel[:, :left].mean(1), wheel[:, left:].mean(1)), 1),
        )

    def _drive(self, row: int, speeds: list[float]) -> None:
        client, body = self._rovers[row]
        pybullet.setJointMotorControlArray(
            body,
            self._wheels,
            pybullet.VELOCITY_CONTROL,
            targetVelocities=speeds,
            forces=self._forces[row],
            physicsClientId=client,
        )

    def _snapshot(self, row: int) -> tuple:
        client, body = self._rovers[row]
        joints = pybullet.getJointStates(body, self._wheels, physicsClientId=client)
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
        for wheel, angle, speed in zip(self._wheels, angles, speeds, strict=True):
            pybullet.resetJointState(body, wheel, angle, speed, physicsClientId=client)


def connect(settings: BulletSettings) -> int:
    """A Bullet client with these settings and gravity, and nothing in it."""
    client = pybullet.connect(pybullet.DIRECT)
    pybullet.setGravity(0, 0, -9.81, physicsClientId=client)
    pybullet.setPhysicsEngineParameter(
        fixedTimeStep=settings.substep,
        numSolverIterations=settings.solver_iterations,
        solverResidualThreshold=settings.solver_residual,
        # Bullet's implicit cone turns friction away from the slip, and halves a skid-steer's yaw rate.
        enableConeFriction=0,
        # Contacts in the same order in every run and in every company.
        deterministicOverlappingPairs=1,
        physicsClientId=client,
    )
    return client


def load_world(client: int, world: World, settings: BulletSettings) -> list[int]:
    """Adds what rovers touch of a world; returns the bodies of its ground."""
    ground = add_ground(client, world)
    frictions = dict.fromkeys(ground, settings.ground_friction)
    frictions |= dict.fromkeys(add_obstacles(client, world.obstacles), settings.obstacle_friction)
    for body, friction in frictions.items():
        _set_contact(client, body, -1, friction, settings)
        pybullet.setCollisionFilterGroupMask(body, -1, _STATIC, _ROVERS, physicsClientId=client)
    return ground


def load_rover(client: int, robot: Robot, settings: BulletSettings) -> int:
    """Loads a rover without damping that never sleeps; returns its body.

    Raises:
        ValueError: if a link of its description has several collision shapes.
    """
    flags = pybullet.URDF_USE_INERTIA_FROM_FILE | pybullet.URDF_USE_IMPLICIT_CYLINDER
    body = pybullet.loadURDF(str(robot.urdf), flags=flags | pybullet.URDF_IGNORE_VISUAL_SHAPES, physicsClientId=client)
    for link in range(-1, pybullet.getNumJoints(body, physicsClientId=client)):
        # Bullet sorts contacts by link; among those of one link their order depends on the other rovers.
        if (shapes := len(pybullet.getCollisionShapeData(body, link, physicsClientId=client))) > 1:
            raise ValueError(f"{robot.urdf}: a link may have one collision shape, link {link} has {shapes}")
        pybullet.changeDynamics(
            body,
            link,
            linearDamping=0.0,
            angularDamping=0.0,
            jointDamping=0.0,
            activationState=pybullet.ACTIVATION_STATE_DISABLE_SLEEPING,
            physicsClientId=client,
        )
        # In the same call the friction would not reach the wheels.
        _set_contact(client, body, link, 1.0, settings)
    _forget_contacts(client, body)
    return body


def _set_contact(client: int, body: int, link: int, friction: float, settings: BulletSettings) -> None:
    """Gives a link its friction, which Bullet multiplies with that of what it touches."""
    pybullet.changeDynamics(
        body,
        link,
        lateralFriction=friction,
        contactProcessingThreshold=settings.contact_threshold,
        physicsClientId=client,
    )


def _forget_contacts(client: int, body: int) -> None:
    """Drops a rover's contacts, which Bullet would keep from before a reset where the new pose is near the old one."""
    for link in range(-1, pybullet.getNumJoints(body, physicsClientId=client)):
        # Setting the filter, even to what it is, makes Bullet find the link's overlapping pairs anew.
        pybullet.setCollisionFilterGroupMask(body, link, _ROVERS, _STATIC, physicsClientId=client)


def _times(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Quaternions ``a`` ``[k, 4]`` times one quaternion ``b`` ``[4]``, (x, y, z, w)."""
    x, y, z, w = b
    # Multiplication by b from the right is linear in a.
    matrix = np.array([[w, z, -y, x], [-z, w, x, y], [y, -x, w, z], [-x, -y, -z, w]])
    return (a[:, None, :] * matrix).sum(-1)


def _matrix(quaternions: np.ndarray) -> np.ndarray:
    """Rotation matrices ``[k, 3, 3]`` of unit quaternions ``[k, 4]``."""
    products = quaternions[:, :, None] * quaternions[:, None, :]
    return (products.reshape(-1, 1, 16) * _ROTATION).sum(-1).reshape(-1, 3, 3)


def _rotation_forms() -> np.ndarray:
    """Each entry of a rotation matrix, row by row, as a linear form in the products of its quaternion: ``[9, 16]``."""
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
