"""Many rovers on one static world, in one Bullet client."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rover_rl.sims.bullet.geometry import add_contact_bodies
from rover_rl.sims.bullet.library import pybullet
from rover_rl.sims.bullet.settings import BulletSettings
from rover_rl.sims.robots import Robot
from rover_rl.sims.worlds import World

_STATIC, _ROVERS = 1, 2
"""Collision groups: rovers touch the world and pass through one another."""


class RoverPhysics:
    """Steps ``count`` rovers in a world of their own; each behaves as if it were alone.

    Bullet speaks of a body's inertial frame, which sits in the centre of mass and is turned to the principal axes of
    inertia; here all poses are those of the base frame.
    """

    def __init__(self, world: World, robot: Robot, count: int, settings: BulletSettings) -> None:
        self._settings = settings
        self.client = client = pybullet.connect(pybullet.DIRECT)
        pybullet.setGravity(0, 0, -9.81, physicsClientId=client)
        pybullet.setPhysicsEngineParameter(
            fixedTimeStep=settings.substep,
            numSolverIterations=settings.solver_iterations,
            solverResidualThreshold=settings.solver_residual,
            # Bullet's implicit cone makes a skid-steer's yaw rate depend on where it faces.
            enableConeFriction=0,
            # Contacts in the same order in every run and in every company.
            deterministicOverlappingPairs=1,
            physicsClientId=client,
        )
        for body in add_contact_bodies(client, world):
            pybullet.changeDynamics(body, -1, lateralFriction=settings.friction, physicsClientId=client)
            pybullet.setCollisionFilterGroupMask(body, -1, _STATIC, _ROVERS, physicsClientId=client)
        self._bodies = [self._load(robot) for _ in range(count)]
        self._wheels = self._find_wheels(robot)
        self._forces = [robot.wheel_torque] * len(self._wheels)
        self._sides = len(robot.left_wheels), len(robot.right_wheels)
        info = pybullet.getDynamicsInfo(self._bodies[0], -1, physicsClientId=client)
        self._inertial_position = np.array(info[3])
        self._inertial_orientation = np.array(info[4])

    def _load(self, robot: Robot) -> int:
        flags = pybullet.URDF_USE_INERTIA_FROM_FILE | pybullet.URDF_USE_IMPLICIT_CYLINDER
        body = pybullet.loadURDF(
            str(robot.urdf), flags=flags | pybullet.URDF_IGNORE_VISUAL_SHAPES, physicsClientId=self.client
        )
        for link in range(-1, pybullet.getNumJoints(body, physicsClientId=self.client)):
            pybullet.setCollisionFilterGroupMask(body, link, _ROVERS, _STATIC, physicsClientId=self.client)
            pybullet.changeDynamics(
                body,
                link,
                lateralFriction=1.0,
                linearDamping=0.0,
                angularDamping=0.0,
                jointDamping=0.0,
                activationState=pybullet.ACTIVATION_STATE_DISABLE_SLEEPING,
                physicsClientId=self.client,
            )
        return body

    def _find_wheels(self, robot: Robot) -> list[int]:
        body = self._bodies[0]
        joints = range(pybullet.getNumJoints(body, physicsClientId=self.client))
        index = {pybullet.getJointInfo(body, j, physicsClientId=self.client)[1].decode(): j for j in joints}
        missing = [name for name in (*robot.left_wheels, *robot.right_wheels) if name not in index]
        if missing:
            raise ValueError(f"{robot.urdf} has no wheel joint {missing[0]!r}; its joints are {sorted(index)}")
        return [index[name] for name in (*robot.left_wheels, *robot.right_wheels)]

    def place(self, rows: Sequence[int], positions: np.ndarray, orientations: np.ndarray) -> None:
        """Puts rovers at rest at poses of their base frames: ``positions [k, 3]``, quaternions ``orientations [k, 4]``."""
        inertial = _quaternion_product(orientations, self._inertial_orientation)
        centers = positions + _rotate(orientations, self._inertial_position)
        still = [0.0] * len(self._wheels)
        for row, center, orientation in zip(rows, centers.tolist(), inertial.tolist(), strict=True):
            self._restore(row, center, orientation, [0, 0, 0], [0, 0, 0], still, still)
            self._drive(row, still)

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
        for _ in range(self._settings.substeps):
            pybullet.stepSimulation(physicsClientId=self.client)
        for row, snapshot in zip(held, before, strict=True):
            self._restore(row, *snapshot)

    def read(self, rows: Sequence[int]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Base positions ``[k, 3]``, orientations ``[k, 4]`` and wheel speeds ``[k, 2]`` (left, right; rad/s) of rows."""
        poses, speeds = [], []
        for row in rows:
            position, orientation = pybullet.getBasePositionAndOrientation(
                self._bodies[row], physicsClientId=self.client
            )
            poses.append(position + orientation)
            joints = pybullet.getJointStates(self._bodies[row], self._wheels, physicsClientId=self.client)
            speeds.append([joint[1] for joint in joints])
        pose = np.array(poses)
        orientation = _quaternion_product(pose[:, 3:], self._inertial_orientation * (-1, -1, -1, 1))
        position = pose[:, :3] - _rotate(orientation, self._inertial_position)
        wheel = np.array(speeds)
        left = self._sides[0]
        return position, orientation, np.stack((wheel[:, :left].mean(1), wheel[:, left:].mean(1)), 1)

    def contacts(self, row: int) -> int:
        """How many points of the rover's body, wheels aside, touch the world."""
        return len(pybullet.getContactPoints(self._bodies[row], linkIndexA=-1, physicsClientId=self.client))

    def _drive(self, row: int, speeds: list[float]) -> None:
        pybullet.setJointMotorControlArray(
            self._bodies[row],
            self._wheels,
            pybullet.VELOCITY_CONTROL,
            targetVelocities=speeds,
            forces=self._forces,
            physicsClientId=self.client,
        )

    def _snapshot(self, row: int) -> tuple:
        body, client = self._bodies[row], self.client
        joints = pybullet.getJointStates(body, self._wheels, physicsClientId=client)
        return (
            *pybullet.getBasePositionAndOrientation(body, physicsClientId=client),
            *pybullet.getBaseVelocity(body, physicsClientId=client),
            [joint[0] for joint in joints],
            [joint[1] for joint in joints],
        )

    def _restore(self, row, position, orientation, velocity, spin, angles, speeds) -> None:  # type: ignore[no-untyped-def]
        body, client = self._bodies[row], self.client
        pybullet.resetBasePositionAndOrientation(body, position, orientation, physicsClientId=client)
        pybullet.resetBaseVelocity(body, velocity, spin, physicsClientId=client)
        for wheel, angle, speed in zip(self._wheels, angles, speeds, strict=True):
            pybullet.resetJointState(body, wheel, angle, speed, physicsClientId=client)


def _quaternion_product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """``a`` ``[k, 4]`` times one quaternion ``b`` ``[4]``, (x, y, z, w)."""
    x, y, z, w = b
    # Right multiplication by b is linear in a.
    matrix = np.array([[w, z, -y, x], [-z, w, x, y], [y, -x, w, z], [-x, -y, -z, w]])
    return (a[:, None, :] * matrix).sum(-1)


def _rotate(quaternions: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """One vector ``[3]`` turned by quaternions ``[k, 4]``: ``[k, 3]``."""
    axis, scalar = quaternions[:, :3], quaternions[:, 3:]
    twice = 2 * np.cross(axis, vector)
    return vector + scalar * twice + np.cross(axis, twice)
