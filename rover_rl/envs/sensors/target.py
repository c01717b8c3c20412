"""Target: where the goal is. No physical sensor, but it is read in the same way."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from rover_rl.envs.sensors.base import Sensor, SensorInput
from rover_rl.envs.specs import Bounds


@dataclass(frozen=True, kw_only=True)
class Target(Sensor):
    """Distance (m) and relative angle (rad) of the goal, ``[N, 2]``."""

    name: str = "target"
    mirror_signs = (1.0, -1.0)

    @property
    def bounds(self) -> Bounds:
        """Bounds of distance (m) and angle (rad)."""
        return Bounds((0.0, -math.pi), (100.0, math.pi))

    def read(self, inputs: SensorInput) -> Tensor:
        """Returns distance and angle."""
        return inputs.target

    def encode(self, value: Tensor) -> Tensor:
        """Encodes the distance on a linear and a logarithmic scale, and the angle also as sine and cosine."""
        distance, angle = value.split(1, -1)
        return torch.cat((distance / 5 - 1, distance.log1p() - 1, angle.sin(), angle.cos(), angle / math.pi), -1)
