"""Sensors of an environment and of a policy, and their readings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from rover_rl.envs.config import LidarConfig, Randomization
from rover_rl.envs.seen_map.seen_map import ROUTE
from rover_rl.envs.sensors import BUILT_IN
from rover_rl.envs.sensors.base import Sensor, SensorInput
from rover_rl.envs.sensors.lidar import Lidar
from rover_rl.registry import Registry
from rover_rl.sims import RoverState

if TYPE_CHECKING:
    from rover_rl.envs.config import SensorLike

_REGISTRY = Registry("sensor", BUILT_IN)
_TAKEN = {*BUILT_IN, "action", "reward", "done", "terminated", "truncated", "outcome", "privileged"}
"""Keys that sensors of one's own cannot have."""


def register_sensor(name: str, sensor: Any) -> None:
    """Registers a sensor under a name, for ``make_env``, ``EnvConfig`` and ``--sensors``.

    Args:
        name: new name of letters, digits, ``_``, ``-`` and ``.``.
        sensor: :class:`Sensor`, function or class without arguments that makes one, or ``"module:attribute"`` of any
            of these.

    Raises:
        ValueError: if the name is taken or has other characters.
    """
    _REGISTRY.register(name, sensor)


def own_sensors(sensors: Sequence[SensorLike]) -> dict[str, Sensor]:
    """Returns the sensors that are given as objects or by name, by the key of their entry.

    Raises:
        ValueError: if a sensor is unknown or something else, or its key is taken.
    """
    found: dict[str, Sensor] = {}
    for each in sensors:
        part = _REGISTRY.find(each) if isinstance(each, str) else each
        if callable(part) and not isinstance(part, Sensor):
            part = _REGISTRY.call(str(each), part)
        if not isinstance(part, Sensor):
            raise ValueError(f"a sensor must be a Sensor, or a function or class that makes one, got {part!r}")
        if part.name in _TAKEN or part.name in found:
            raise ValueError(f"sensors cannot add {part.name!r}, which is there already: choose another name")
        found[part.name] = part
    return found


def policy_sensors(lidar: LidarConfig, own: Sequence[SensorLike] = ()) -> dict[str, Sensor]:
    """Returns the sensors that a policy can read, by the key of their entry.

    Args:
        lidar: settings of the lidar.
        own: sensors of one's own, as objects or by name.

    Raises:
        ValueError: as :func:`own_sensors`.
    """
    sensors: dict[str, Sensor] = {name: _REGISTRY.find(name)() for name in BUILT_IN}
    sensors["lidar"] = Lidar(points=lidar.points, max_range=lidar.max_range, period=lidar.period)
    return sensors | own_sensors(own)


def environment_sensors(lidar: LidarConfig, own: Sequence[SensorLike] = ()) -> dict[str, Sensor]:
    """Returns the sensors that an environment reads, by key: those of a policy, but the route, which has a memory."""
    return {name: sensor for name, sensor in policy_sensors(lidar, own).items() if name != ROUTE}


class Observer:
    """Computes observations.

    Args:
        sensors: sensors to read, by key.
        device: device of the observations.
    """

    def __init__(self, sensors: Mapping[str, Sensor], device: torch.device) -> None:
        self._sensors = sensors
        self._held: dict[str, Tensor] = {}
        self._is_checked = False
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
        """Returns the observation, each entry ``[N, k]``.

        Raises:
            ValueError: if a reading does not fit the bounds of its sensor.
        """
        values = {}
        for key, sensor in self._sensors.items():
            value = sensor.read(inputs)
            if not self._is_checked:
                _check(sensor, value, len(inputs.steps))
            if key in self._limits:
                value = value.clamp(*self._limits[key])
            values[key] = value if sensor.period == 1 else self._hold(sensor, value, inputs.steps)
        self._is_checked = True
        return values

    def _hold(self, sensor: Sensor, value: Tensor, steps: Tensor) -> Tensor:
        """Returns the value in the rows whose sensor reads in this step, and its last reading in the others."""
        last = self._held.get(sensor.name, value)
        self._held[sensor.name] = held = torch.where(steps % sensor.period == 0, value, last)
        return held


def _check(sensor: Sensor, value: Tensor, rows: int) -> None:
    """Raises an error for a reading that does not fit the bounds of its sensor."""
    shape = rows, len(sensor.bounds.low)
    if value.shape != shape or value.dtype != torch.float32:
        raise ValueError(
            f"sensor {sensor.name!r} must read float32 {shape} by its bounds, got {value.dtype} {(*value.shape,)}"
        )
