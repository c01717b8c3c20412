"""The entries of an observation: bounds, and how each is computed. A new sensor is a line in :data:`ENTRIES`."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from rover_rl.envs.config import LidarConfig
from rover_rl.envs.perception import Perception
from rover_rl.envs.specs import Bounds
from rover_rl.sims.worlds import World
from rover_rl.sims.worlds.region import overlap


class Entry(NamedTuple):
    """One entry of the observation.

    Attributes:
        bounds: its bounds, given the lidar.
        read: its value ``[N, k]``, from what the sensors report and the target (distance in m and angle in rad,
            ``[N, 2]``).
        clip: whether the value can leave the bounds, and is clipped to them.
    """

    bounds: Callable[[LidarConfig], Bounds]
    read: Callable[[Perception, Tensor], Tensor]
    clip: bool = True


def _imu(sensed: Perception, target: Tensor) -> Tensor:
    roll, pitch, yaw = sensed.euler.split(1, -1)
    return torch.cat((pitch, roll, yaw), -1)


def _velocities(sensed: Perception, target: Tensor) -> Tensor:
    return torch.cat((sensed.rover.linear_velocity, sensed.rover.angular_velocity), -1)


_POSE = Bounds((-30.0, -30.0, -10.0), (30.0, 30.0, 10.0))

ENTRIES: dict[str, Entry] = {
    "lidar": Entry(
        lambda lidar: Bounds((0.0,) * lidar.points, (lidar.max_range,) * lidar.points),
        lambda sensed, target: sensed.readings,
        clip=False,
    ),
    "pose": Entry(lambda lidar: _POSE, lambda sensed, target: sensed.rover.position),
    "imu": Entry(lambda lidar: Bounds((-math.pi,) * 3, (math.pi,) * 3), _imu, clip=False),
    "target": Entry(lambda lidar: Bounds((0.0, -math.pi), (100.0, math.pi)), lambda sensed, target: target),
    "velocities": Entry(lambda lidar: Bounds((-10.0, -10.0), (10.0, 10.0)), _velocities),
}
"""The contract's observation, by name: meters, radians, m/s and rad/s."""


def observation_bounds(lidar: LidarConfig) -> dict[str, Bounds]:
    """Bounds of each entry of the observation."""
    return {key: entry.bounds(lidar) for key, entry in ENTRIES.items()}


def clipped_pose(world: World) -> list[str]:
    """Returns a sentence about a world in which ``pose`` is clipped; an empty list for another world.

    ``pose`` is clipped where the rover may drive and is farther from the origin than its bounds.
    """
    (x_low, y_low, _), (x_high, y_high, _) = _POSE.low, _POSE.high
    driven = overlap(world.bounds, world.terrain.extent)
    if overlap(driven, ((x_low, x_high), (y_low, y_high))) == driven:
        return []
    reach = max(abs(end) for axis in driven for end in axis)
    return [
        f"pose: {world.name!r} reaches {reach:.0f} m from the origin, and the observation `pose` is clipped at "
        f"{x_high:.0f} m: set closer bounds, move the world to the origin, or train without `pose` "
        "(`target` stays exact)"
    ]


class Observer:
    """Computes observations.

    Args:
        lidar: settings of the lidar.
        device: device of the observations.
    """

    def __init__(self, lidar: LidarConfig, device: torch.device | str | None = None) -> None:
        bounds = observation_bounds(lidar)
        self._clip = {key: bounds[key].tensors(device) for key, entry in ENTRIES.items() if entry.clip}

    def __call__(self, sensed: Perception, target: Tensor) -> dict[str, Tensor]:
        """The observation, each entry ``[N, k]``.

        Args:
            sensed: what the sensors report.
            target: distance (m) and relative angle (rad) of the goal, ``[N, 2]``, unclipped.
        """
        values = {key: entry.read(sensed, target) for key, entry in ENTRIES.items()}
        return {
            key: torch.clamp(value, *self._clip[key]) if key in self._clip else value for key, value in values.items()
        }
