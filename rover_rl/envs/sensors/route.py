"""Route: the shortest way to the goal on the map of what the lidar has seen."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from rover_rl.envs.seen_map.seen_map import ROUTE
from rover_rl.envs.sensors.base import Sensor, SensorInput
from rover_rl.envs.sensors.target import Target
from rover_rl.envs.specs import Bounds


@dataclass(frozen=True, kw_only=True)
class Route(Sensor):
    """Distance (m) and angle (rad) of two corners, and length (m; -1 without a path), ``[N, 5]``.

    The map is a memory, so that a transform reads it:
    :class:`~rover_rl.envs.transforms.route_observation.RouteObservation`.
    """

    name: str = ROUTE
    mirror_signs = (1.0, -1.0, 1.0, -1.0, 1.0)

    @property
    def bounds(self) -> Bounds:
        """Bounds of distances (m) and angles (rad) of the corners, and of the length (m)."""
        return Bounds((0.0, -math.pi, 0.0, -math.pi, -1.0), (100.0, math.pi, 100.0, math.pi, 1000.0))

    def read(self, inputs: SensorInput) -> Tensor:
        """Raises an error: the transform reads the map."""
        raise NotImplementedError("append RouteObservation to the environment, which adds the route")

    def encode(self, value: Tensor) -> Tensor:
        """Encodes two corners like targets, and the length, for which no path counts as none left."""
        first, second, length = value.split((2, 2, 1), -1)
        left, target = length.clamp(min=0), Target()
        rest = (left / 10 - 1, left.log1p() - 1, (length < 0).to(length.dtype))
        return torch.cat((target.encode(first), target.encode(second), *rest), -1)
