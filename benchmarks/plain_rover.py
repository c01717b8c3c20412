"""Conventional environment for the same task: one rover, one PyBullet client, Gymnasium and NumPy.

This is the baseline of ``benchmarks/peers.py``. Rover, ground, obstacles, physics and lidar beams are those of
:class:`rover_rl.RoverEnv`. The rest is minimal: observation, reward, terminations, and untimed spawns from its maps.
"""

from __future__ import annotations

import math

import gymnasium
import numpy as np
import pybullet
import torch
from gymnasium import spaces

from rover_rl.robots import get_robot
from rover_rl.rotations import matrix_to_quaternion
from rover_rl.sims.bullet import BulletSettings
from rover_rl.sims.bullet.geometry import connect, friction_scales, load_world
from rover_rl.sims.bullet.rover import load_rovers
from rover_rl.sims.free_space import free_space, rest_on_ground
from rover_rl.worlds import get_world

_RAYS, _ROVER, _STATIC = 1, 2, 4  # collision groups. Bullet assigns rays to the first.


class PlainRover(gymnasium.Env):
    """Point navigation with one rover. An episode is truncated after ``length`` steps."""

    def __init__(
        self, world: str = "inspect", beams: int = 128, settings: BulletSettings | None = None, length: int = 2000
    ) -> None:
        self.action_space = spaces.Box(np.array([-1, -np.pi], np.float32), np.array([1, np.pi], np.float32))
        self.observation_space = spaces.Dict(
            {
                "lidar": spaces.Box(0, 12, (32,), np.float32),
                "pose": spaces.Box(-np.inf, np.inf, (3,), np.float32),
                "imu": spaces.Box(-np.pi, np.pi, (3,), np.float32),
                "target": spaces.Box(-np.inf, np.inf, (2,), np.float32),
                "velocities": spaces.Box(-np.inf, np.inf, (2,), np.float32),
            }
        )
        self._settings = settings or BulletSettings()
        self._friction_scales = friction_scales(self._settings.substeps)
        self._robot = get_robot("rover_zero")
        self._world = get_world(world)
        self._cells = free_space(self._world, self._robot).goal_cells.double().numpy()
        self._length = length
        angles = np.arange(beams) * (2 * np.pi / beams)
        self._beams = self._robot.lidar_range * np.stack((np.cos(angles), np.sin(angles), np.zeros(beams)), 1)
        self._load()

    def _load(self) -> None:
        settings = self._settings
        self._client = client = connect(settings)
        self._ground, _ = load_world(client, self._world, settings)
        for body in range(pybullet.getNumBodies(physicsClientId=client)):
            # Static bodies collide with rays and the rover, not with one another.
            pybullet.setCollisionFilterGroupMask(body, -1, _STATIC, _RAYS | _ROVER, physicsClientId=client)
        self._body = load_rovers(client, self._robot, settings, 1)[0]
        names = [*self._robot.drive.left, *self._robot.drive.right]
        joints = range(pybullet.getNumJoints(self._body, physicsClientId=client))
        index = {pybullet.getJointInfo(self._body, j, physicsClientId=client)[1].decode(): j for j in joints}
        self._wheels = [index[name] for name in names]
        self._torques = [self._robot.drive.torque] * len(names)
        info = pybullet.getDynamicsInfo(self._body, -1, physicsClientId=client)
        self._center, self._inertial = info[3], info[4]

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[dict, dict]:
        super().reset(seed=seed)
        self._goal = self._cells[self.np_random.integers(len(self._cells))]
        self._steps = self._collided = 0
        x, y = self._cells[self.np_random.integers(len(self._cells))]
        self.place(x, y, self.np_random.uniform(-np.pi, np.pi))
        return self._observe(), {}

    def place(self, x: float, y: float, yaw: float) -> None:
        """Places the rover on the ground, at rest."""
        pose = torch.tensor([[x, y, yaw]])
        position, rotation = rest_on_ground(self._world, self._robot, pose)
        quaternion = matrix_to_quaternion(rotation)[0].tolist()
        center, turned = pybullet.multiplyTransforms(position[0].tolist(), quaternion, self._center, self._inertial)
        pybullet.resetBasePositionAndOrientation(self._body, center, turned, physicsClientId=self._client)
        pybullet.resetBaseVelocity(self._body, (0, 0, 0), (0, 0, 0), physicsClientId=self._client)
        for wheel in self._wheels:
            pybullet.resetJointState(self._body, wheel, 0.0, 0.0, physicsClientId=self._client)
        self._drive(0.0, 0.0)
        for link in range(-1, pybullet.getNumJoints(self._body, physicsClientId=self._client)):
            # Rays do not hit the rover. Setting the mask at every reset also clears old contacts.
            pybullet.setCollisionFilterGroupMask(self._body, link, _ROVER, _STATIC, physicsClientId=self._client)
        self._twist, self._error = np.zeros(2), 0.0

    def step(self, action: np.ndarray) -> tuple[dict, float, bool, bool, dict]:
        robot, dt = self._robot, self._settings.control_dt
        error = math.remainder(float(action[1]), 2 * math.pi)
        turn = min(max(2.0 * error + 0.1 * (error - self._error) / dt, -7.0), 7.0)
        self._error = error
        limit = np.array((robot.drive.max_linear_acceleration, robot.drive.max_angular_acceleration)) * dt
        twist = self._twist + np.clip(np.array((action[0], turn)) - self._twist, -limit, limit)
        (v, w), self._twist = (self._twist + twist) / 2, twist
        half = robot.drive.separation / 2
        left, right = (v - w * half) / robot.wheels.radius, (v + w * half) / robot.wheels.radius
        self._drive(left, right)
        for scales in self._friction_scales:
            for ground in self._ground:
                pybullet.changeDynamics(ground, -1, anisotropicFriction=scales, physicsClientId=self._client)
            pybullet.stepSimulation(physicsClientId=self._client)
        before = self._distance
        observation = self._observe()
        self._steps += 1
        self._collided = self._collided + 1 if observation["lidar"].min() < 0.3 else 0
        (x_low, x_high), (y_low, y_high) = self._world.bounds
        x, y = observation["pose"][:2]
        flipped = abs(observation["imu"][:2]).max() > 1.48
        ended = bool(flipped or self._collided > 15 or not (x_low < x < x_high and y_low < y < y_high))
        reward = 0.45 * (before - self._distance) + 0.0025 * self._speeds[0] - 0.0015 * abs(self._speeds[1])
        if ended:
            reward = -20.0
        elif self._distance < 0.5:
            reward = 100.0
            self._goal = self._cells[self.np_random.integers(len(self._cells))]
        elif self._collided:
            reward = -0.5
        return observation, reward, ended, self._steps >= self._length, {}

    def _drive(self, left: float, right: float) -> None:
        pybullet.setJointMotorControlArray(
            self._body,
            self._wheels,
            pybullet.VELOCITY_CONTROL,
            targetVelocities=[left] * len(self._robot.drive.left) + [right] * len(self._robot.drive.right),
            forces=self._torques,
            physicsClientId=self._client,
        )

    def _observe(self) -> dict[str, np.ndarray]:
        position, orientation = pybullet.getBasePositionAndOrientation(self._body, physicsClientId=self._client)
        joints = pybullet.getJointStates(self._body, self._wheels, physicsClientId=self._client)
        x, y, z, w = orientation
        rotation = np.array(pybullet.getMatrixFromQuaternion(orientation)).reshape(3, 3)
        origin = np.array(position) + rotation @ (np.array(self._robot.lidar_position) - self._center)
        ends = origin + self._beams @ rotation.T
        starts = np.broadcast_to(origin, ends.shape).copy()
        hits = pybullet.rayTestBatch(starts, ends, collisionFilterMask=_STATIC, physicsClientId=self._client)
        ranges = np.fromiter((hit[2] for hit in hits), np.float64, len(hits)) * self._robot.lidar_range
        roll = math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
        pitch = math.asin(min(1.0, max(-1.0, 2 * (w * y - z * x))))
        yaw = math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
        wheels = [joint[1] for joint in joints]
        middle = len(self._robot.drive.left)
        left, right = sum(wheels[:middle]) / middle, sum(wheels[middle:]) / (len(wheels) - middle)
        radius, separation = self._robot.wheels.radius, self._robot.drive.separation
        self._speeds = radius * (left + right) / 2, radius * (right - left) / separation
        dx, dy = self._goal[0] - position[0], self._goal[1] - position[1]
        self._distance = math.hypot(dx, dy)
        bearing = math.remainder(math.atan2(dy, dx) - yaw, 2 * math.pi)
        return {
            "lidar": ranges.reshape(32, -1).min(1).astype(np.float32),
            "pose": np.array(position, np.float32),
            "imu": np.array((pitch, roll, yaw), np.float32),
            "target": np.array((self._distance, bearing), np.float32),
            "velocities": np.array(self._speeds, np.float32),
        }

    def close(self) -> None:
        if pybullet.isConnected(self._client):
            pybullet.disconnect(self._client)
