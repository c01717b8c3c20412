"""Visits: how long the rover has been at the places around it, on its way to the goal."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from rover_rl.envs.sensors.base import Sensor, SensorInput, SensorSetup
from rover_rl.envs.sensors.suite import VISITS
from rover_rl.envs.specs import Bounds
from rover_rl.sims.free_space.fitting import passage_scale

DIRECTIONS, DISTANCES = 16, (0.75, 1.5, 3.0)
"""Number of directions, and distances of the places in them, m."""
CELL, SIZE = 0.75, 64
"""Size of a cell, m, and cells along each side of the map, which repeats: places 48 m apart share a cell."""
LONGEST = 1e4
"""Bound of a time, s."""


@dataclass(frozen=True, kw_only=True)
class Visits(Sensor):
    """Times that the rover has spent at the places around it, since it has had this goal, ``[N, 49]``, s.

    The first place is where the rover is. The others are 0.75 m away in 16 directions, from ahead counterclockwise,
    then 1.5 m and 3 m. Times are kept in cells of 0.75 m, and shared and read between their centers. For a robot that
    needs generated worlds with wider passages, all lengths grow by their scale.

    With it, a policy sees which ways it has tried. It is computed from the known pose alone: there is no map of
    obstacles and no route.

    Example:
        >>> env = RoverEnv(world_n="maze", num_envs=2, seed=0, sensors=["visits"])
        >>> env.rollout(3)["visits"].shape
        torch.Size([2, 3, 49])
    """

    name: str = VISITS
    clips = False
    delayed = None
    takes_long = True
    bounds = Bounds((0.0,) * (1 + len(DISTANCES) * DIRECTIONS), (LONGEST,) * (1 + len(DISTANCES) * DIRECTIONS))

    def reader(self, setup: SensorSetup) -> Callable[[SensorInput], Tensor]:
        return _Reader(self, setup)

    def encode(self, value: Tensor) -> Tensor:
        """Returns ``log(1 + t) / 2`` of a time ``t``, which is 1 at 6.4 s."""
        return value.log1p() / 2

    def mirror(self, value: Tensor) -> Tensor:
        """Mirrors the directions: b becomes -b."""
        around = value[..., 1:].unflatten(-1, (-1, DIRECTIONS)).flip(-1).roll(1, -1).flatten(-2)
        return torch.cat((value[..., :1], around), -1)


class _Reader:
    def __init__(self, sensor: Visits, setup: SensorSetup) -> None:
        rows, device = len(setup.fleet), setup.fleet.index.device
        self._period, self._fleet = sensor.period, setup.fleet
        self._cells = setup.fleet.table(lambda robot: [CELL * passage_scale(robot)])
        self._seconds = sensor.period * setup.control_dt
        angles = torch.arange(DIRECTIONS, device=device) * (2 * math.pi / DIRECTIONS)
        ring, distances = torch.stack((angles.cos(), angles.sin()), -1), torch.tensor(DISTANCES, device=device) / CELL
        self._places = torch.cat((ring.new_zeros(1, 2), (distances[:, None, None] * ring).flatten(0, 1)))
        self._goals = torch.zeros(rows, 2, device=device)
        self._map = torch.zeros(rows, SIZE * SIZE, device=device)
        self._times = torch.zeros(rows, len(self._places), device=device)

    def __call__(self, inputs: SensorInput) -> Tensor:
        # Importing NVIDIA Warp takes half a second.
        from rover_rl.envs.sensors.visits_kernels import visit
        from rover_rl.native.warp import launch_rows, wp

        due, pose = inputs.due(self._period), inputs.observation["pose"]
        position = pose[:, :2] / self._cells[self._fleet.index]
        frames = wp.from_torch(torch.cat((position, inputs.observation["imu"][:, 2:]), -1), dtype=wp.vec3)
        places, self._times = wp.from_torch(self._places, dtype=wp.vec2), self._times.clone()
        renewed = due & ((inputs.steps == 0).squeeze(-1) | (inputs.goal != self._goals).any(-1))
        self._goals = torch.where(due[:, None], inputs.goal, self._goals)
        given = [due, renewed, frames, places, self._seconds, SIZE, self._map, self._times]
        launch_rows(visit, due.shape, given, due.device)
        return self._times
