"""Pose: position in the world."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from rover_rl.envs.sensors.base import Sensor, SensorInput
from rover_rl.envs.specs import Bounds
from rover_rl.sims.worlds import World
from rover_rl.sims.worlds.region import overlap

WAVELENGTHS = (64.0, 16.0, 4.0)
"""Wavelengths of the sine and cosine features of a position, m. The largest world is 64 m wide."""


@dataclass(frozen=True, kw_only=True)
class Pose(Sensor):
    """Position in the world frame as :class:`~rover_rl.envs.config.PoseConfig` has it, ``[N, 3]``, m.

    With it, a policy would memorize the map.
    """

    name: str = "pose"

    @property
    def bounds(self) -> Bounds:
        """Bounds of the position, m."""
        return Bounds((-30.0, -30.0, -10.0), (30.0, 30.0, 10.0))

    def read(self, inputs: SensorInput) -> Tensor:
        """Returns the position."""
        return inputs.pose.position

    def encode(self, value: Tensor) -> Tensor:
        """Encodes x and y as waves of several lengths."""
        wave_numbers = 2 * math.pi / value.new_tensor(WAVELENGTHS)
        phase = (value[..., :2, None] * wave_numbers).flatten(-2)
        return torch.cat((phase.sin(), phase.cos(), value[..., 2:]), -1)


def clipped_pose(world: World) -> list[str]:
    """Returns a sentence about a world in which ``pose`` is clipped; an empty list for another world.

    ``pose`` is clipped where the rover may drive and is farther from the origin than its bounds.
    """
    bounds = Pose().bounds
    (x_low, y_low, _), (x_high, y_high, _) = bounds.low, bounds.high
    driven = overlap(world.bounds, world.terrain.extent)
    if overlap(driven, ((x_low, x_high), (y_low, y_high))) == driven:
        return []
    reach = max(abs(end) for axis in driven for end in axis)
    return [
        f"pose: {world.name!r} reaches {reach:.0f} m from the origin, and the observation `pose` is clipped at "
        f"{x_high:.0f} m: set closer bounds, move the world to the origin, or train without `pose` "
        "(`target` stays exact)"
    ]
