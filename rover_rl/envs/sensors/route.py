"""The way to the goal on the map of what the lidar has seen, and the distances on this map."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from rover_rl.envs.seen_map.scans import SIZE
from rover_rl.envs.seen_map.seen_map import SeenMap
from rover_rl.envs.sensors.base import Observer, Sensor, SensorInput, SensorSetup
from rover_rl.envs.sensors.standard import Target
from rover_rl.envs.sensors.suite import ROUTE, SEEN_DISTANCES
from rover_rl.envs.specs import Bounds

FARTHEST_CELL = 1e6
"""Bound of the places of cells, m."""


@dataclass(frozen=True, kw_only=True)
class Route(Sensor):
    """Distance (m) and angle (rad) of two corners, and length (m; -1 without a path), ``[N, 5]``.

    The route is the shortest one around the obstacles that the rover has seen in this episode, within the bounds of the
    world: see :class:`~rover_rl.envs.seen_map.seen_map.SeenMap`. It is computed from the lidar, the pose and the IMU
    alone, so that a policy may read it wherever it drives.

    Args:
        period: number of steps from one scan that is added to the map to the next. With
            :class:`~rover_rl.envs.transforms.action_repeat.ActionRepeat`, that of a decision.

    Example:
        >>> env = RoverEnv(world_n="maze", num_envs=4, seed=0, sensors=["route"])
        >>> env.rollout(3)["route"].shape
        torch.Size([4, 3, 5])
    """

    name: str = ROUTE
    clips = False
    delayed = None
    takes_long = True
    mirror_signs = (1.0, -1.0, 1.0, -1.0, 1.0)
    bounds = Bounds((0.0, -math.pi, 0.0, -math.pi, -1.0), (100.0, math.pi, 100.0, math.pi, 1000.0))

    def reader(self, setup: SensorSetup) -> Callable[[SensorInput], Tensor]:
        return MapReader(self, setup)

    def encode(self, value: Tensor) -> Tensor:
        """Encodes two corners like targets, and the length, for which no path counts as none left."""
        first, second, length = value.split((2, 2, 1), -1)
        left, target = length.clamp(min=0), Target()
        rest = (left / 10 - 1, left.log1p() - 1, (length < 0).to(length.dtype))
        return torch.cat((target.encode(first), target.encode(second), *rest), -1)


@dataclass(frozen=True, kw_only=True)
class SeenDistances(Sensor):
    """Distances to what the lidar has seen, and where they are, ``[N, SIZE * SIZE + 3]``, m.

    See :meth:`SeenMap.distances <rover_rl.envs.seen_map.seen_map.SeenMap.distances>`. For planners, not for networks.
    The ``period`` is that of :class:`Route`.
    """

    name: str = SEEN_DISTANCES
    clips = False
    delayed = None
    takes_long = True
    bounds = Bounds((0.0,) * SIZE**2 + (-FARTHEST_CELL,) * 2 + (0.0,), (100.0,) * SIZE**2 + (FARTHEST_CELL,) * 3)

    def reader(self, setup: SensorSetup) -> Callable[[SensorInput], Tensor]:
        return MapReader(self, setup, has_distances=True)


class MapReader:
    """Reads a :class:`Route` or :class:`SeenDistances`, and keeps the maps ``seen`` of a batch of rovers for it."""

    def __init__(self, sensor: Route | SeenDistances, setup: SensorSetup, has_distances: bool = False) -> None:
        self._period, self._distances = sensor.period, has_distances
        self.seen = SeenMap(setup.fleet, setup.lidar, sensor.period * setup.control_dt)

    def __call__(self, inputs: SensorInput) -> Tensor:
        due, observation = inputs.due(self._period), inputs.observation
        route = self.seen(observation, due, due & (inputs.steps == 0).squeeze(-1), inputs.bounds)
        return torch.cat(self.seen.distances(observation, inputs.bounds, due), -1) if self._distances else route


def map_of(observer: Observer) -> SeenMap | None:
    """Returns the maps that the sensors of an observer keep of what rovers have seen; ``None`` if none of them does."""
    return next((one.seen for one in observer.readers.values() if isinstance(one, MapReader)), None)
