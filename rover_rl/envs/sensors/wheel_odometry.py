"""Wheel odometry: speed and yaw rate."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from rover_rl.envs.config import Randomization
from rover_rl.envs.rng import random_bits, to_normal
from rover_rl.envs.sensors.base import Sensor, SensorInput
from rover_rl.envs.specs import Bounds
from rover_rl.sims import RoverState

_NOISE, _SIDEWAYS_NOISE = 5, 10
"""Streams of random numbers."""


@dataclass(frozen=True, kw_only=True)
class WheelOdometry(Sensor):
    """Forward speed (m/s) and yaw rate (rad/s), ``[N, 2]``."""

    name: str = "velocities"
    mirror_signs = (1.0, -1.0)

    @property
    def bounds(self) -> Bounds:
        """Bounds of speed (m/s) and yaw rate (rad/s)."""
        return Bounds((-10.0, -10.0), (10.0, 10.0))

    def read(self, inputs: SensorInput) -> Tensor:
        """Returns speed and yaw rate."""
        rover = inputs.sensed.rover
        return torch.cat((rover.linear_velocity, rover.angular_velocity), -1)

    def sense(self, noise: Randomization, rover: RoverState, keys: Tensor, step: Tensor) -> dict[str, Tensor]:
        """Scales the velocities by random factors of about 1."""
        if not noise.odometry_noise:
            return {}
        factors = 1 + noise.odometry_noise * to_normal(random_bits(keys, _NOISE, step, 2))
        linear, angular = factors.split(1, -1)
        return {"linear_velocity": rover.linear_velocity * linear, "angular_velocity": rover.angular_velocity * angular}

    def encode(self, value: Tensor) -> Tensor:
        """Returns the speed, and the yaw rate in units of 3 rad/s."""
        speed, yaw_rate = value.split(1, -1)
        return torch.cat((speed, yaw_rate / 3), -1)


@dataclass(frozen=True, kw_only=True)
class SidewaysOdometry(Sensor):
    """Speed to the left by the wheels of a drive that moves sideways, ``[N, 1]``, m/s.

    Add it to the robot: ``Robot.from_urdf("omni.urdf", drive=..., sensors=(SidewaysOdometry(),))``.
    """

    name: str = "sideways"
    mirror_signs = (-1.0,)

    @property
    def bounds(self) -> Bounds:
        """Bounds of the speed, m/s."""
        return Bounds((-10.0,), (10.0,))

    def read(self, inputs: SensorInput) -> Tensor:
        """Returns the speed to the left; 0 for a drive that does not move sideways."""
        rover = inputs.sensed.rover
        return torch.zeros_like(rover.dt) if rover.lateral_velocity is None else rover.lateral_velocity

    def sense(self, noise: Randomization, rover: RoverState, keys: Tensor, step: Tensor) -> dict[str, Tensor]:
        """Scales the speed by a random factor of about 1."""
        if not noise.odometry_noise or rover.lateral_velocity is None:
            return {}
        factor = 1 + noise.odometry_noise * to_normal(random_bits(keys, _SIDEWAYS_NOISE, step, 1))
        return {"lateral_velocity": rover.lateral_velocity * factor}

    def encode(self, value: Tensor) -> Tensor:
        """Returns the speed in m/s."""
        return value
