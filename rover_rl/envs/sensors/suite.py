"""Sensors of an environment and of a policy, and their readings."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from rover_rl.envs.config import LidarConfig, Randomization
from rover_rl.envs.seen_map.seen_map import ROUTE
from rover_rl.envs.sensors import BUILT_IN
from rover_rl.envs.sensors.base import Sensor, SensorInput
from rover_rl.envs.sensors.lidar import Lidar
from rover_rl.registry import Registry
from rover_rl.sims import RoverState

_REGISTRY = Registry("sensor", BUILT_IN)


def policy_sensors(lidar: LidarConfig) -> dict[str, Sensor]:
    """Returns the sensors that a policy can read, by the key of their entry."""
    sensors: dict[str, Sensor] = {name: _REGISTRY.find(name)() for name in BUILT_IN}
    return sensors | {"lidar": Lidar(points=lidar.points, max_range=lidar.max_range, period=lidar.period)}


def environment_sensors(lidar: LidarConfig) -> dict[str, Sensor]:
    """Returns the sensors that an environment reads, by key: those of a policy, but the route, which has a memory."""
    return {name: sensor for name, sensor in policy_sensors(lidar).items() if name != ROUTE}


class Observer:
    """Computes observations.

    Args:
        sensors: sensors to read, by key.
        device: device of the observations.
    """

    def __init__(self, sensors: Mapping[str, Sensor], device: torch.device) -> None:
        self._sensors = sensors
        self._limits = {key: each.bounds.tensors(device) for key, each in sensors.items() if each.clips}

    def sense(self, noise: Randomization, rover: RoverState, keys: Tensor, step: Tensor) -> RoverState:
        """Adds the noise of the sensors to a state. Returns the same object if there is none.

        Args:
            noise: parameters of the noise.
            rover: true state of the rovers, ``[N]``.
            keys: random keys of the episodes, ``[N, 1]``.
            step: index of the step in its episode, ``[N, 1]``.
        """
        sensed: dict[str, Tensor] = {}
        for sensor in self._sensors.values():
            sensed |= sensor.sense(noise, rover, keys, step)
        return RoverState.pack(**(dict(rover.items()) | sensed)) if sensed else rover

    def __call__(self, inputs: SensorInput) -> dict[str, Tensor]:
        """Returns the observation, each entry ``[N, k]``."""
        values = {}
        for key, sensor in self._sensors.items():
            value = sensor.read(inputs)
            values[key] = value.clamp(*self._limits[key]) if key in self._limits else value
        return values
