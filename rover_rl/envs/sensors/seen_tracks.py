"""``SeenTracks``: what is followed in the scans of a batch of rovers, from observation to observation."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from typing import Any, ClassVar

import torch
from tensordict import TensorDictBase
from torch import Tensor

from rover_rl.envs.config import SCAN_POSE, LidarConfig
from rover_rl.envs.sensors.base import Rig, RigSensor, SensorInput
from rover_rl.envs.sensors.lidar_mask import known_readings
from rover_rl.envs.sensors.scan_pose import taken_at
from rover_rl.envs.sensors.suite import LIDAR_MASK
from rover_rl.robots import Robot
from rover_rl.robots.fleet import Fleet


class SeenTracks(ABC):
    """What a tracker follows around the rovers of a batch, from scan to scan.

    Args:
        rows: number N of rovers.
        lidar: settings of the lidar.
        robot: robot that carries it, or the robots of the rows.
        device: device of the observations.
        interval: time from one scan to the next, s.
    """

    tracker: ClassVar[Callable[..., Any]]
    """Class of the tracker."""
    remembered: ClassVar[int]
    """Numbers of the state of a row's tracks."""
    told: ClassVar[int]
    """Numbers of the values of a row."""

    def __init__(
        self, rows: int, lidar: LidarConfig, robot: Robot | Fleet, device: torch.device, interval: float
    ) -> None:
        self._tracker = type(self).tracker(robot, lidar, interval)
        self._state = torch.zeros(rows, self.remembered, device=device)
        self._values = torch.zeros(rows, self.told, device=device)

    @abstractmethod
    def values(self, tracks: Any, observation: Mapping[str, Tensor]) -> Tensor:
        """Returns the values of the sensor, ``[N, told]``, for what the tracker returns beside its state."""

    def __call__(
        self,
        observation: TensorDictBase | Mapping[str, Tensor],
        rows: Tensor | None = None,
        renewed: Tensor | None = None,
    ) -> Tensor:
        """Adds the scans of an observation and returns the values of the sensor, ``[N, told]``.

        Args:
            observation: observation, ``[N]`` each, with ``lidar``, ``pose`` and ``imu``, and with ``scan_pose`` if
                scans can be late, and ``lidar_mask`` if beams can be hidden.
            rows: rows whose scan is added, bool ``[N]``; ``None``: all.
            renewed: rows whose episode begins, bool ``[N]``. They know of no tracks.
        """
        if renewed is not None:
            self._state = self._state.masked_fill(renewed[:, None], 0.0)
        entries = {key: observation.get(key, None) for key in ("lidar", "pose", "imu", SCAN_POSE, LIDAR_MASK)}
        read = {key: value for key, value in entries.items() if value is not None}
        if rows is None or self._state.device.type != "cpu":
            state, values = self._follow(self._state, read, due=rows)
            keep = torch.ones_like(state[:, :1], dtype=torch.bool) if rows is None else rows[:, None]
            self._state, self._values = torch.where(keep, state, self._state), torch.where(keep, values, self._values)
            return self._values
        # On the CPU, the few rows that begin an episode between two scans take little time.
        index = rows.nonzero().squeeze(-1)
        state, values = self._follow(self._state[index], {key: value[index] for key, value in read.items()}, index)
        self._state, self._values = self._state.index_copy(0, index, state), self._values.index_copy(0, index, values)
        return self._values

    def _follow(
        self, state: Tensor, observation: Mapping[str, Tensor], index: Tensor | None = None, due: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """Returns the next tracks, and the values of the sensor, in the rows of an ``index``."""
        pose, imu = taken_at(observation) or (observation["pose"], observation["imu"])
        state, tracks = self._tracker(state, known_readings(observation), pose, imu, index, due)
        return state, self.values(tracks, observation)


def reader_of(seen: type[SeenTracks], sensor: RigSensor, rig: Rig) -> Callable[[SensorInput], Tensor]:
    """Returns a reader of a sensor, with tracks of its own."""
    tracks = seen(rig.rows, rig.lidar, rig.fleet or rig.robot, rig.device, sensor.period * rig.control_dt)

    def read(inputs: SensorInput) -> Tensor:
        due = inputs.due(sensor.period)
        return tracks(inputs.observation, due, due & (inputs.steps == 0).squeeze(-1))

    return read
