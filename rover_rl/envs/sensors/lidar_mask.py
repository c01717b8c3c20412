"""Mask of the lidar: which of its readings beams cover, so that what is free can be told from what is unknown."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import torch
from tensordict import TensorDictBase
from torch import Tensor

from rover_rl.envs.config import LidarConfig
from rover_rl.envs.sensors.base import Rig, Sensor, SensorInput
from rover_rl.envs.sensors.standard import LidarPooling, hidden_beams
from rover_rl.envs.sensors.suite import LIDAR_MASK
from rover_rl.envs.specs import Bounds
from rover_rl.sims.rays import seen
from rover_rl.sims.rover_state import beam_angles

WHOLE = 0.9999
"""Share of the beams from which on a reading is covered. The mean of many ones may be a little less than 1."""


@dataclass(frozen=True, kw_only=True)
class LidarMask(Sensor):
    """Share of the beams of each lidar reading that see, ``[N, points]``: 1 if all of them do, 0 if none does.

    Beams outside of the robot's ``lidar_view`` do not see, nor those that ``Randomization`` hides (``lidar_view``,
    ``dead_sectors`` and ``lidar_min_range``). On a live rover, a beam sees if a valid reading of the scan covers it:
    neither directions outside of the scan's ``angle_min`` and ``angle_max`` do, nor NaN, nor ranges outside of its
    limits.

    A reading with a mask of 0 is the maximum. The map of what has been seen and the tracks of what moves take readings
    with a mask below 1 for unknown, not for free, if the observation has this entry. An environment has it if
    ``Randomization`` hides beams, or if it is asked for. Number of readings and period are those of its lidar.

    Example:
        >>> env = RoverEnv(num_envs=2, seed=0, robot="jackal", sensors=["lidar_mask"])
        >>> env.reset()["lidar_mask"][0, 10:14]
        tensor([1.0000, 1.0000, 0.2500, 0.0000])
    """

    name: str = LIDAR_MASK
    points: int = LidarConfig.points
    clips = False
    delayed = "scan"

    @property
    def bounds(self) -> Bounds:
        return Bounds((0.0,) * self.points, (1.0,) * self.points)

    def reader(self, rig: Rig) -> Callable[[SensorInput], Tensor]:
        lidar, fleet, noise = rig.lidar, rig.fleet, rig.randomization
        angles = beam_angles(lidar.beams)
        views = fleet.table(lambda robot: seen(angles, robot.lidar_view).tolist(), torch.bool)
        pooling = LidarPooling(lidar.beams, lidar.points, lidar.max_range, fleet.index.device)

        def read(inputs: SensorInput) -> Tensor:
            covered, live = views[fleet.index], inputs.surroundings.live
            if noise.hides_beams:
                covered = covered & ~hidden_beams(noise, inputs.keys, inputs.truth.ranges)
            if live is not None:
                covered = covered & live.covered()
            return pooling.grouped(covered.float()).mean(-1)

        return read

    def mirror(self, value: Tensor) -> Tensor:
        return value.flip(-1)


def known_readings(observation: Mapping[str, Tensor] | TensorDictBase) -> Tensor:
    """Returns the lidar readings of an observation, ``[N, points]``, m; -1 where its mask says that one is unknown."""
    mask = observation.get(LIDAR_MASK, None)
    return observation["lidar"] if mask is None else torch.where(mask < WHOLE, -1.0, observation["lidar"])
