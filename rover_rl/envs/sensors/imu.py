"""IMU: attitude and heading."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from rover_rl.envs.config import Randomization
from rover_rl.envs.rng import random_bits, to_normal
from rover_rl.envs.sensors.base import Sensor, SensorInput
from rover_rl.envs.specs import Bounds
from rover_rl.sims import RoverState
from rover_rl.sims.rotations import quaternion_product

_NOISE = 6
"""Stream of random numbers."""


@dataclass(frozen=True, kw_only=True)
class Imu(Sensor):
    """Pitch, roll and yaw, ``[N, 3]``, rad.

    Args:
        name: key of the entry.
        period: number of steps from one reading to the next.
        heading: whether networks read the yaw. Only policies of one map need it.
    """

    name: str = "imu"
    heading: bool = False
    clips = False
    mirror_signs = (1.0, -1.0, -1.0)

    @property
    def bounds(self) -> Bounds:
        """Bounds of the angles, rad."""
        return Bounds((-math.pi,) * 3, (math.pi,) * 3)

    def read(self, inputs: SensorInput) -> Tensor:
        """Returns the angles."""
        roll, pitch, yaw = inputs.sensed.euler.split(1, -1)
        return torch.cat((pitch, roll, yaw), -1)

    def sense(self, noise: Randomization, rover: RoverState, keys: Tensor, step: Tensor) -> dict[str, Tensor]:
        """Turns the rover by a small angle about a random axis."""
        if not noise.imu_noise:
            return {}
        # The vector part of the quaternion of a small rotation is half the rotation vector.
        turn = 0.5 * noise.imu_noise * to_normal(random_bits(keys, _NOISE, step, 3))
        turn = torch.cat((turn, torch.ones_like(turn[:, :1])), -1)
        return {"orientation": quaternion_product(rover.orientation, turn / turn.norm(dim=-1, keepdim=True))}

    def encode(self, value: Tensor) -> Tensor:
        """Encodes tilts in units of about 20 degrees, and the yaw, if networks read it, as sine and cosine."""
        tilt, yaw = value[..., :2] * 3, value[..., 2:]
        return torch.cat((tilt, yaw.sin(), yaw.cos()), -1) if self.heading else tilt
