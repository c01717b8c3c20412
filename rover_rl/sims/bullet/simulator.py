"""Bullet backend: batched rovers in one or several worlds, and their lidars."""

from __future__ import annotations

import gc
import weakref
from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from operator import itemgetter
from typing import Any

import numpy as np
import torch
from torch import Tensor

from rover_rl.native.bullet import disconnect, pybullet
from rover_rl.robots import Robot
from rover_rl.rotations import rotation_forms
from rover_rl.sims.bullet import BulletSettings, rover
from rover_rl.sims.bullet.geometry import add_mesh_bodies, connect, friction_scales, load_world, set_contact
from rover_rl.sims.bullet.rover import MoverBodies
from rover_rl.sims.rover_state import Force, beam_angles
from rover_rl.sims.world_groups import Change, GroupedSimulator, NearParts, WorldGroup, fastest_point
from rover_rl.worlds import Solids, World
from rover_rl.worlds.clearance import SolidTest
from rover_rl.worlds.movers import Part

ROVERS_PER_CLIENT = 64
"""Maximum number of rovers in a Bullet client, on which results do not depend.

More rovers no longer fit in the processor's cache and take two to three times as long each.
"""
STEERING_TORQUE = 50.0
"""Maximum torque of a steering joint, N m: enough to turn a wheel on the spot."""
STEERING_GAIN = 0.5
"""Share of the remaining angle that a steering joint turns in a physics step."""

_CONJUGATE = np.array((-1.0, -1.0, -1.0, 1.0))
_ROTATION = rotation_forms().double().reshape(9, 16).numpy()
RAYS_PER_CALL = 1024
"""Rays per call of ``rayTestBatch``.

A result has ten Python objects per ray. The results of a small call stay in the processor's cache, which makes reading
and freeing them 20 % cheaper. With 16,384 rays or more, ``rayTestBatch`` returns nothing and raises no error.
"""
RAYS_PER_BLOCK = 8192
"""Rays whose start and end points are computed at once."""


class BulletSimulator(GroupedSimulator):
    """Simulator in PyBullet. Consecutive rovers in the same world share clients for the physics and the lidar."""

    features = GroupedSimulator.features | {"lidar"}

    def __init__(self, worlds: Sequence[World], robot: Robot, settings: BulletSettings | None = None) -> None:
        self._clients: list[int] = []
        self._finalizer = weakref.finalize(self, disconnect, self._clients)
        super().__init__(worlds, robot, settings or BulletSettings())

    def _group(self, world: World, rows: slice) -> BulletGroup:
        group = BulletGroup(world, rows, self._robot, self.settings)
        self._clients += group.clients
        return group

    def scanner(self, beams: int) -> BulletScanner:
        angles = beam_angles(beams).numpy()
        lidars = {group: BulletLidar(group.world, self._robot, angles) for group in self._groups}
        self._clients += [lidar.client for lidar in lidars.values()]
        return BulletScanner(self._each, lidars, self.num_envs, beams)

    def close(self) -> None:
        self._finalizer()
        super().close()


class BulletGroup(WorldGroup):
    """Rovers in one world, in the Bullet clients ``clients``. ``orientation`` are rotation matrices.

    Bullet states the pose of a body's inertial frame, whose origin is the center of mass and whose axes are the
    principal axes of inertia. The poses of this class are those of the base frame.
    """

    def __init__(self, world: World, rows: slice, robot: Robot, settings: BulletSettings) -> None:
        super().__init__(world, rows)
        count, self._settings = len(self.every), settings
        self.orientation = np.zeros((count, 3, 3))
        self._friction_scales = friction_scales(settings.substeps)
        self.clients: list[int] = []
        self._statics: list[tuple[list[int], list[int]]] = []
        self._rovers: list[tuple[int, int]] = []
        for first in range(0, count, ROVERS_PER_CLIENT):
            client = connect(settings)
            self.clients.append(client)
            self._statics.append(load_world(client, world, settings))
            bodies = rover.load_rovers(client, robot, settings, min(ROVERS_PER_CLIENT, count - first))
            self._rovers += [(client, body) for body in bodies]
        client, body = self._rovers[0]
        corners = rover.bounding_box(client, body)
        self._near = NearObstacles(Solids.of(world.obstacles), *corners, fastest_point(robot) * settings.control_dt)
        self.reach = float(np.linalg.norm(np.abs(corners).max(0)))
        self._movers: MoverBodies | None = None
        self._meters: rover.Meters | None = None
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
        self._rollers = [index[rover.roller_joint(name)] for name in rolling]
        free = [*(index[name] for name in drive.passive), *self._rollers]
        self._joints = [*self._wheels, *free, *self._steering]
        for client, body in self._rovers:
            for joint in free:
                # Bullet holds a joint without a command.
                mode = pybullet.VELOCITY_CONTROL
                pybullet.setJointMotorControl2(body, joint, mode, force=0.0, physicsClientId=client)

    def add_movers(self, parts: Sequence[Part]) -> None:
        self._movers = MoverBodies(self._rovers, parts, self._settings)

    def measure(self, reports: Mapping[Force, np.ndarray]) -> None:
        wheels, inertial = self._wheels, self._inertial_orientation
        self._meters = rover.Meters(reports, self._rovers, wheels, inertial, self._settings.substeps)

    def place(self, local: np.ndarray, position: np.ndarray, orientation: np.ndarray) -> None:
        inertial = _quaternion_products(orientation, self._inertial_orientation)
        centers = position + (_rotation_matrices(orientation) * self._inertial_position).sum(-1)
        zeros, still, ahead = ([0.0] * len(joints) for joints in (self._joints, self._wheels, self._steering))
        if self._movers is not None:
            self._movers.clear(local.tolist())
        for row, center, turn in zip(local.tolist(), centers.tolist(), inertial.tolist(), strict=True):
            self._restore(row, center, turn, [0, 0, 0], [0, 0, 0], zeros, zeros)
            self._set_motors(row, still, ahead)
            rover.clear_contacts(*self._rovers[row])

    def set_dynamics(self, row: int, scales: Sequence[float]) -> None:
        friction, chassis_mass, motor_torque = scales
        client, body = self._rovers[row]
        for link in rover.links_of(client, body):
            set_contact(client, body, link, friction, self._settings)
        mass, inertia = self._mass * chassis_mass, (self._inertia * chassis_mass).tolist()
        pybullet.changeDynamics(body, -1, mass=mass, localInertiaDiagonal=inertia, physicsClientId=client)
        self._forces[row] = [self._torque * motor_torque] * len(self._wheels)

    def step(
        self, local: np.ndarray, speeds: np.ndarray, angles: np.ndarray, near: NearParts | None = None
    ) -> np.ndarray:
        held = np.setdiff1d(self.every, local).tolist() if len(local) < len(self.every) else []
        before = [self._snapshot(row) for row in held]
        for row, targets in enumerate(zip(speeds[:, self._motors].tolist(), angles.tolist(), strict=True)):
            self._set_motors(row, *targets)
        pairs = self._near.find(self.position, self.orientation)
        touched, pushed = np.zeros((2, len(speeds)), dtype=bool)
        bodies = None if near is None else self._movers
        if bodies is not None and near is not None:
            bodies.approach(near)
        for number, (client, (grounds, obstacles)) in enumerate(zip(self.clients, self._statics, strict=True)):
            own = [(row, obstacles[index]) for row, index in pairs if row // ROVERS_PER_CLIENT == number]
            moving = [] if bodies is None else bodies.near(client)
            for substep, scales in enumerate(self._friction_scales):
                for ground in grounds:
                    pybullet.changeDynamics(ground, -1, anisotropicFriction=scales, physicsClientId=client)
                if bodies is not None:
                    bodies.move(client, substep * self._settings.substep)
                pybullet.stepSimulation(physicsClientId=client)
                self._straighten_rollers(number)
                rover.feel(self._rovers, own, touched)
                rover.feel(self._rovers, moving, pushed)
                if self._meters is not None:
                    self._meters.read(client, own, moving)
        for row, snapshot in zip(held, before, strict=True):
            self._restore(row, *snapshot)
        if self._meters is not None:
            self._meters.finish(local)
        return np.stack((touched | pushed, pushed), -1)[local]

    def read(self, local: np.ndarray) -> np.ndarray:
        poses: list[float] = []
        speeds: list[float] = []
        angles: list[float] = []
        wheels, steering = self._wheels, self._steering
        for row in local.tolist():
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
        turn = _quaternion_products(pose[:, 3:], self._inertial_orientation * _CONJUGATE)
        self.orientation[local] = rotation = _rotation_matrices(turn)
        self.position[local] = place = pose[:, :3] - (rotation * self._inertial_position).sum(-1)
        motors = np.stack([wheel[:, own].mean(1) for own in self._motor_wheels], 1)
        return np.concatenate((place, turn, motors, np.array(angles).reshape(len(pose), -1)), 1)

    def _set_motors(self, row: int, speeds: list[float], angles: list[float]) -> None:
        (client, body), forces, mode = self._rovers[row], self._forces[row], pybullet.VELOCITY_CONTROL
        pybullet.setJointMotorControlArray(
            body, self._wheels, mode, targetVelocities=speeds, forces=forces, physicsClientId=client
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
        pose = pybullet.getBasePositionAndOrientation(body, physicsClientId=client)
        twist = pybullet.getBaseVelocity(body, physicsClientId=client)
        return *pose, *twist, [joint[0] for joint in joints], [joint[1] for joint in joints]

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
        self._center, self._half, self._margin = (low + high) / 2, (high - low) / 2, way

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
    products = quaternions[:, :, None] * quaternions[:, None, :]
    return (products.reshape(-1, 1, 16) * _ROTATION).sum(-1).reshape(-1, 3, 3)


class BulletLidar:
    """Lidar that scans the static geometry of one world with beams at ``angles [beams]`` (rad) from straight ahead.

    It calls ``rayTestBatch`` in a client that holds this geometry alone: in that of the physics, the broad phase would
    test every ray against the bounding boxes of all rovers.
    """

    def __init__(self, world: World, robot: Robot, angles: np.ndarray) -> None:
        self.client = pybullet.connect(pybullet.DIRECT)
        self._mount, self._range = np.array(robot.lidar_position), robot.lidar_range
        add_mesh_bodies(self.client, world, self._range)
        self._directions = self._range * np.stack((np.cos(angles), np.sin(angles)))
        self._solids = SolidTest(world.terrain, world.obstacles)
        # Reused buffers: new memory would have to be paged in for every scan.
        rovers = max(1, RAYS_PER_BLOCK // len(angles))
        self._starts, self._ends = np.empty((2, rovers, len(angles), 3))

    def scan(self, position: np.ndarray, orientation: np.ndarray) -> np.ndarray:
        """Scans from base frames at positions ``[k, 3]`` (m), with rotation matrices ``[k, 3, 3]``."""
        origins = position + (orientation * self._mount).sum(-1)
        fractions = np.empty((len(origins), self._directions.shape[1]))
        rovers, collects = len(self._starts), gc.isenabled()
        # The garbage collector would traverse the short-lived tuples of a scan without freeing any.
        gc.disable()
        try:
            for first in range(0, len(origins), rovers):
                block = slice(first, first + rovers)
                self._cast(origins[block], orientation[block], fractions[block].reshape(-1))
        finally:
            if collects:
                gc.enable()
        ranges = self._range * fractions
        ranges[ranges >= self._range] = np.inf
        ranges[self._solids.contains(origins)] = 0.0
        return ranges

    def _cast(self, origins: np.ndarray, rotation: np.ndarray, fractions: np.ndarray) -> None:
        """Writes the free fraction of each ray of at most as many rovers as the buffers hold, ``[k * beams]``."""
        starts, ends = self._starts[: len(origins)], self._ends[: len(origins)]
        ahead, left = self._directions
        starts[...] = origins[:, None]
        np.multiply(ahead[:, None], rotation[:, None, :, 0], out=ends)
        ends += left[:, None] * rotation[:, None, :, 1]
        ends += starts
        starts, ends = starts.reshape(-1, 3), ends.reshape(-1, 3)
        for ray in range(0, len(starts), RAYS_PER_CALL):
            call = slice(ray, ray + RAYS_PER_CALL)
            hits = pybullet.rayTestBatch(starts[call], ends[call], physicsClientId=self.client)
            if len(hits) != len(starts[call]):
                raise RuntimeError(f"Bullet returned {len(hits)} of {len(starts[call])} lidar rays")
            fractions[call] = np.fromiter(map(itemgetter(2), hits), np.float64, len(hits))


class BulletScanner:
    """Lidar on every rover, an implementation of :class:`rover_rl.sims.base.Scanner`."""

    def __init__(
        self, each: Callable[[Change, Any], None], lidars: Mapping[WorldGroup, BulletLidar], count: int, beams: int
    ) -> None:
        self.angles = beam_angles(beams).float()
        self._each, self._lidars = each, lidars
        self._ranges = np.full((count, beams), np.inf, dtype=np.float32)

    def scan(self, rows: Tensor | None = None) -> Tensor:

        def scan(group: WorldGroup, local: np.ndarray, rows: Any) -> None:
            self._ranges[rows] = self._lidars[group].scan(group.position[local], group.orientation[local])

        self._each(scan, None if rows is None else rows.numpy())
        return torch.from_numpy(self._ranges.copy())
