"""Route: the shortest way to the goal on the map of what the lidar has seen."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from rover_rl.envs.seen_map.seen_map import SeenMap
from rover_rl.envs.sensors.base import Rig, RigSensor, SensorInput
from rover_rl.envs.sensors.standard import Target
from rover_rl.envs.sensors.suite import ROUTE
from rover_rl.envs.specs import Bounds


@dataclass(frozen=True, kw_only=True)
class Route(RigSensor):
    """Distance (m) and angle (rad) of two corners, and length (m; -1 without a path), ``[N, 5]``.

    The route is the shortest one around the obstacles that the rover has seen in this episode, within the bounds of the
    world: see :class:`~rover_rl.envs.seen_map.seen_map.SeenMap`. It is computed from the lidar, the pose and the IMU
    alone, so that a policy may read it wherever it drives.

    Args:
        name: key of the entry.
        period: number of steps from one scan that is added to the map to the next. With
            :class:`~rover_rl.envs.transforms.action_repeat.ActionRepeat`, that of a decision.
        threads: number of CPU threads. Results do not depend on it.

    Example:
        >>> env = RoverEnv(world_n="maze", num_envs=4, seed=0, sensors=["route"])
        >>> env.rollout(3)["route"].shape
        torch.Size([4, 3, 5])
    """

    name: str = ROUTE
    threads: int = 1
    clips = False
    delayed = None
    takes_long = True
    mirror_signs = (1.0, -1.0, 1.0, -1.0, 1.0)
    bounds = Bounds((0.0, -math.pi, 0.0, -math.pi, -1.0), (100.0, math.pi, 100.0, math.pi, 1000.0))

    def reader(self, rig: Rig) -> Callable[[SensorInput], Tensor]:
        """Returns a reader with maps of its own."""
        interval = self.period * rig.control_dt
        seen = SeenMap(rig.rows, rig.lidar, rig.fleet or rig.robot, rig.device, self.threads, interval)

        def read(inputs: SensorInput) -> Tensor:
            due = inputs.due(self.period)
            return seen(inputs.observation, due, due & (inputs.steps == 0).squeeze(-1), inputs.bounds)

        return read

    def encode(self, value: Tensor) -> Tensor:
        """Encodes two corners like targets, and the length, for which no path counts as none left."""
        first, second, length = value.split((2, 2, 1), -1)
        left, target = length.clamp(min=0), Target()
        rest = (left / 10 - 1, left.log1p() - 1, (length < 0).to(length.dtype))
        return torch.cat((target.encode(first), target.encode(second), *rest), -1)
