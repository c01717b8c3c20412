"""Rigid-body physics of the rovers in one world, in Bullet."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from rover_rl.native.bullet import pybullet
from rover_rl.robots import Robot
from rover_rl.rotations import rotation_forms
from rover_rl.sims.bullet.geometry import connect, friction_scales, load_world, set_contact
from rover_rl.sims.bullet.meters import Meters
from rover_rl.sims.bullet.movers import MoverBodies
from rover_rl.sims.bullet.rover import bounding_box, clear_contacts, is_touching, load_rovers, roller_joint
from rover_rl.sims.bullet.settings import BulletSettings
from rover_rl.sims.movers.near import NearParts, fastest_point
from rover_rl.sims.rover_state import Force
from rover_rl.worlds import Solids, World
from rover_rl.worlds.movers import Part

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
_ROTATION = rotation_forms().double().reshape(9, 16).numpy()


class Reading(NamedTuple):
    """Poses and joints of ``k`` rovers, float64.

    Positions ``[k, 3]`` (m), quaternions (x, y, z, w) ``[k, 4]`` and rotation matrices ``[k, 3, 3]`` of the base
    frames; mean speed of the wheels of each motor (rad/s) and angle of each steering joint (rad), ``[k, M + S]``.
    """

    position: np.ndarray
    orientation: np.ndarray
    rotation: np.ndarray
    joints: np.ndarray


class RoverPhysics:
    """Physics of ``count`` rovers in one world, in the Bullet clients ``clients``. The rovers do not interact.

    Bullet states the pose of a body's inertial frame, whose origin is the center of mass and whose axes are the
    principal axes of inertia. The poses of this class are those of the base frame.
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
            self._rovers += [(client, body) for body in load_rovers(client, robot, settings, len(rovers))]
        client, body = self._rovers[0]
        corners = bounding_box(client, body)
        self._near = NearObstacles(Solids.of(world.obstacles), *corners, fastest_point(robot) * settings.control_dt)
        # Radius of a sphere around the base frame that contains the rover, m.
        self.reach = float(np.linalg.norm(np.abs(corners).max(0)))
        self._movers: MoverBodies | None = None
        self._meters: Meters | None = None
        self._find_joints(robot)
        self._torque = robot.drive.torque
        self._forces = [[self._torque] * len(self._wheels) for _ in range(count)]
        info = pybullet.getDynamicsInfo(body, -1, physicsClientId=client)
        self._mass, self._inertia = info[0], np.array(info[2])
        self._inertial_position, self._inertial_orientation = np.array(info[3]), np.array(info[4])

    def _find_joints(self, robot: Robot) -> None:
        """Finds the indices of the joints, and lets those without a motor turn freely."""
        drive, (client, body) = robot.drive, self._rovers[0]
        joints = range(pybullet.getNumJoints(body, physicsClientId=client))
        index = {pybullet.getJointInfo(body, j, physicsClientId=client)[1].decode(): j for j in joints}
        self._wheels = [index[name] for motor in drive.motors for name in motor]
        self._motors = [motor for motor in drive.motor_of_wheel if motor >= 0]
        self._motor_wheels = [slice(*ends) for ends in pairwise(np.cumsum([0, *map(len, drive.motors)]).tolist())]
        self._steering = [index[name] for name in drive.steering]
        rolling = [name for name, angle in zip(drive.wheels, drive.rollers, strict=False) if angle is not None]
        self._rollers = [index[roller_joint(name)] for name in rolling]
        passive = [index[name] for name in drive.passive]
        self._joints = [*self._wheels, *passive, *self._steering, *self._rollers]
        for client, body in self._rovers:
            for joint in (*passive, *self._rollers):
                # Bullet holds a joint without a command.
                mode = pybullet.VELOCITY_CONTROL
                pybullet.setJointMotorControl2(body, joint, mode, force=0.0, physicsClientId=client)

    def meet(self, parts: Sequence[Part]) -> None:
        """Lets parts of movers push the rovers."""
        self._movers = MoverBodies(self._rovers, parts, self._settings) if parts else None

    def report(self, reports: Mapping[Force, np.ndarray]) -> None:
        """Measures the fields ``[count, k]`` in each control step from now on."""
        wheels, inertial = self._wheels, self._inertial_orientation
        self._meters = Meters(reports, self._rovers, wheels, inertial, self._settings.substeps)

    def place(self, rows: Sequence[int], positions: np.ndarray, orientations: np.ndarray) -> None:
        """Places base frames at positions ``[k, 3]`` and orientations (x, y, z, w) ``[k, 4]``, at rest."""
        inertial = _quaternion_products(orientations, self._inertial_orientation)
        centers = positions + (_rotation_matrices(orientations) * self._inertial_position).sum(-1)
        zeros, still = [0.0] * len(self._joints), [0.0] * len(self._wheels)
        ahead = [0.0] * len(self._steering)
        if self._movers is not None:
            self._movers.clear(rows)
        for row, center, orientation in zip(rows, centers.tolist(), inertial.tolist(), strict=True):
            self._restore(row, center, orientation, [0, 0, 0], [0, 0, 0], zeros, zeros)
            self._set_motors(row, still, ahead)
            clear_contacts(*self._rovers[row])

    def set_dynamics(self, row: int, friction: float, chassis_mass: float, motor_torque: float) -> None:
        """Scales the dynamics of one rover relative to its description. See :class:`~rover_rl.sims.base.Dynamics`."""
        client, body = self._rovers[row]
        for link in range(-1, pybullet.getNumJoints(body, physicsClientId=client)):
            set_contact(client, body, link, friction, self._settings)
        pybullet.changeDynamics(
            body,
            -1,
            mass=self._mass * chassis_mass,
            localInertiaDiagonal=(self._inertia * chassis_mass).tolist(),
            physicsClientId=client,
        )
        self._forces[row] = [self._torque * motor_torque] * len(self._wheels)

    def step(
        self,
        speeds: list[list[float]],
        angles: list[list[float]],
        poses: np.ndarray,
        held: Sequence[int] = (),
        movers: NearParts | None = None,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Advances the world by one control step.

        Args:
            speeds: speed of each motor (rad/s) of every rover.
            angles: angle of each steering joint (rad) of every rover.
            poses: positions (m) and orientations (x, y, z, w) of the base frames before the step, ``[count, 7]``.
            held: rows for which no time passes. Their states are restored after the step.
            movers: parts of movers near the rovers.

        Returns:
            Whether each rover touched an obstacle or a mover in any of the physics steps, and whether it touched a
            mover, bool ``[count]`` each.
        """
        before = [self._snapshot(row) for row in held]
        for row, turning in enumerate(speeds):
            self._set_motors(row, [turning[motor] for motor in self._motors], angles[row])
        near = self._near.find(poses[:, :3].astype(float), _rotation_matrices(poses[:, 3:].astype(float)))
        touched, pushed = np.zeros((2, len(speeds)), dtype=bool)
        bodies = None if movers is None else self._movers
        if bodies is not None and movers is not None:
            bodies.approach(movers)
        for number, client in enumerate(self.clients):
            pairs = [(row, obstacle) for row, obstacle in near if row // ROVERS_PER_CLIENT == number]
            for substep, scales in enumerate(self._friction_scales):
                for ground in self._grounds[number]:
                    pybullet.changeDynamics(ground, -1, anisotropicFriction=scales, physicsClientId=client)
                if bodies is not None:
                    bodies.move(client, substep * self._settings.substep)
                pybullet.stepSimulation(physicsClientId=client)
                self._straighten_rollers(number)
                for row, obstacle in pairs:
                    if not touched[row]:
                        touched[row] = is_touching(*self._rovers[row], self._obstacles[number][obstacle])
                if bodies is not None:
                    bodies.feel(client, pushed)
                if self._meters is not None:
                    near_bodies = [(row, self._obstacles[number][obstacle], False) for row, obstacle in pairs]
                    near_bodies += [(*pair, True) for pair in (() if bodies is None else bodies.near(client))]
                    self._meters.read(client, near_bodies)
        for row, snapshot in zip(held, before, strict=True):
            self._restore(row, *snapshot)
        if self._meters is not None:
            self._meters.finish(held)
        return touched | pushed, pushed

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
        position = pose[:, :3] - (rotation * self._inertial_position).sum(-1)
        motors = np.stack([wheel[:, own].mean(1) for own in self._motor_wheels], 1)
        joints = np.concatenate((motors, np.array(angles).reshape(len(pose), -1)), 1)
        return Reading(position, orientation, rotation, joints)

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


class NearObstacles:
    """Broad phase: finds the obstacles that rovers may touch in a control step, by axis-aligned bounding boxes.

    A query of Bullet's contacts takes a few microseconds. Most rovers are far from all obstacles and need none.
    ``low`` and ``high`` are the corners ``[3]`` (m) of the rover's bounding box in the base frame, and ``way`` is how
    far a point of it moves in a control step, m.
    """

    def __init__(self, obstacles: Solids, low: np.ndarray, high: np.ndarray, way: float) -> None:
        self._low, self._high = obstacles.bounding_boxes
        self._center, self._half = (low + high) / 2, (high - low) / 2
        self._margin = way

    def find(self, position: np.ndarray, rotation: np.ndarray) -> list[tuple[int, int]]:
        """Returns the indices of pairs of a rover and an obstacle near it, from ``[k, 3]`` and ``[k, 3, 3]``."""
        if not len(self._low):
            return []
        center = position + (rotation * self._center).sum(-1)
        half = (np.abs(rotation) * self._half).sum(-1) + self._margin
        apart = ((center - half)[:, None] > self._high) | ((center + half)[:, None] < self._low)
        return [(row, obstacle) for row, obstacle in np.argwhere(~apart.any(-1)).tolist()]


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
