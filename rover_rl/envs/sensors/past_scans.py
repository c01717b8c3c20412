"""Past scans: what the lidar saw before, as seen from where the rover is now."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from rover_rl.checks import MAX_COUNT, check_at_least
from rover_rl.envs.config import LidarConfig
from rover_rl.envs.seen_map.scans import reading_directions
from rover_rl.envs.sensors.base import Sensor, SensorInput, SensorSetup
from rover_rl.envs.sensors.standard import taken_at
from rover_rl.envs.specs import Bounds

CHANGE = 4.0
"""Factor of the changes that a network reads: 1 is what has come from 3 m to 2.1 m."""


@dataclass(frozen=True, kw_only=True)
class PastScans(Sensor):
    """The lidar scan and earlier ones, as they would look from the pose now, ``[N, (1 + count) * points]``, m.

    What rests has the same ranges in all of them, as far as the rover knows its pose. What differs has moved, whether
    or not :class:`~rover_rl.envs.sensors.movers.Movers` follows it.
    The latest scan is the first. At the start of an episode, all are the first scan. Networks read the latest one and
    the changes since the others with convolutions over the directions.

    Args:
        count: number of earlier scans.
        apart: number of steps from one scan to the next, a multiple of the period. Training reads once for a decision,
            of ``action_repeat`` steps.
        points: number of directions, from ahead counterclockwise. A direction without a reading has ``max_range``: with
            half as many directions as the lidar has readings, there are no gaps on a wall that has come nearer.
        max_range: largest range, m.

    Example:
        >>> env = RoverEnv(world_n="plaza", num_envs=2, seed=0, sensors=[PastScans(count=3)])
        >>> env.rollout(5)["past_scans"].unflatten(-1, (4, 16)).shape
        torch.Size([2, 5, 4, 16])
    """

    name: str = "past_scans"
    count: int = 3
    apart: int = 6
    points: int = 16
    max_range: float = LidarConfig.max_range
    clips = False
    delayed = None
    takes_long = True

    def __post_init__(self) -> None:
        super().__post_init__()
        check_at_least(1, MAX_COUNT, count=self.count, apart=self.apart, points=self.points)
        if self.apart % self.period:
            raise ValueError(
                f"apart of sensor {self.name!r} must be a multiple of its period, {self.period} steps, got {self.apart}"
            )

    @property
    def bounds(self) -> Bounds:
        size = (1 + self.count) * self.points
        return Bounds((0.0,) * size, (self.max_range,) * size)

    @property
    def image(self) -> tuple[int, int]:
        return 1, self.points

    def reader(self, setup: SensorSetup) -> Callable[[SensorInput], Tensor]:
        return _KeptScans(self, setup)

    def encode(self, value: Tensor) -> Tensor:
        """Returns the logarithm of the ranges now, as for the lidar, and by how much it exceeds the earlier ones.

        The direction ahead is in the middle of the row, so that the ends are behind.
        """
        now, before = value.log1p().unflatten(-1, (-1, self.points)).split((1, self.count), -2)
        scans = torch.cat((now / 1.3 - 1, (CHANGE * (now - before)).clamp(-1, 1)), -2)
        return scans.roll(self.points // 2, -1).flatten(-2)

    def mirror(self, value: Tensor) -> Tensor:
        """Mirrors the scans: direction b becomes -b."""
        return value.unflatten(-1, (-1, self.points)).flip(-1).roll(1, -1).flatten(-2)


class _KeptScans:
    def __init__(self, sensor: PastScans, setup: SensorSetup) -> None:
        fleet, lidar = setup.fleet, setup.lidar
        rows, device = len(fleet), fleet.index.device
        self._sensor, self._fleet, self._no_return = sensor, fleet, lidar.max_range - 1e-3
        self._lag = sensor.apart // sensor.period  # kept scans from one that is shown to the next
        self._mounts = fleet.table(lambda robot: robot.lidar_position[:2])
        self._directions = reading_directions(lidar).to(device)
        self._ends = torch.zeros(rows, 1 + sensor.count * self._lag, lidar.points, 2, device=device)
        self._latest = torch.zeros(rows, dtype=torch.int32, device=device)  # place of each row's last scan
        self._ranges = torch.zeros(rows, 1 + sensor.count, sensor.points, device=device)

    def __call__(self, inputs: SensorInput) -> Tensor:
        # Importing NVIDIA Warp takes half a second.
        from rover_rl.envs.sensors.past_scans_kernels import keep, show
        from rover_rl.native.warp import launch_options, wp

        sensor, entries, rows = self._sensor, inputs.observation, len(self._ranges)
        due = inputs.due(sensor.period)
        renewed, options = due & (inputs.steps == 0).squeeze(-1), launch_options(due.device)
        self._latest = torch.where(due, (self._latest + 1) % self._ends.shape[1], self._latest)
        beams = entries["lidar"].contiguous(), self._no_return, self._directions
        taken, now = self._frames(*taken_at(entries)), self._frames(entries["pose"], entries["imu"])
        wp.launch(keep, rows, [due, renewed, *beams, taken, self._latest, self._ends], **options)
        ranges = self._ranges.masked_fill(due[:, None, None], sensor.max_range)
        wp.launch(show, (rows, 1 + sensor.count), [due, now, self._latest, self._lag, self._ends, ranges], **options)
        self._ranges = ranges
        return ranges.flatten(1)

    def _frames(self, pose: Tensor, imu: Tensor) -> Tensor:
        cos, sin = imu[:, 2].cos(), imu[:, 2].sin()
        x, y = self._mounts[self._fleet.index].unbind(-1)
        return torch.stack((pose[:, 0] + cos * x - sin * y, pose[:, 1] + sin * x + cos * y, imu[:, 2]), -1)
