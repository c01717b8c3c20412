"""Privileged observation: quantities that are known only in simulation, for critics and experts, not for policies."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from tensordict import TensorDict
from torch import Tensor

from rover_rl.envs.sensors.movers import NEAREST, NUMBERS, put_in_order
from rover_rl.envs.stages import Perception
from rover_rl.envs.task import target_info
from rover_rl.robots import Robot
from rover_rl.sims.free_space.goal_fields import GoalFields
from rover_rl.sims.movers.field import MoverField
from rover_rl.sims.rover_state import Dynamics
from rover_rl.tensordicts import unchecked_tensordict
from rover_rl.worlds.world import World, Worlds

MAP_DISTANCES = (0.5, 1.5)
"""Distances of the points of the local map from the rover's center, m."""
MAP_BEARINGS = 16
"""Number of directions of the local map, counterclockwise from straight ahead."""
FEATURES = {
    **{"position": 3, "attitude": 3, "velocities": 2, "target": 2, "path_distance": 1},
    "local_map": len(MAP_DISTANCES) * MAP_BEARINGS,
    "movers": NEAREST * NUMBERS,
    **dict.fromkeys(("friction", "chassis_mass", "motor_torque", "latency"), 1),
}
"""Entries of the privileged observation and their numbers of features."""


class PrivilegedObservation:
    """Computes the privileged observation: float32 ``[N, k]``, not clipped.

    - ``position`` (x, y, z, m), ``attitude`` (roll, pitch, yaw, rad), and ``velocities``: wheel odometry without noise,
      m/s and rad/s;
    - ``target``: distance (m) and relative angle (rad) of the goal;
    - ``path_distance``: distance to the goal along the shortest free path, m;
    - ``local_map``: how much shorter the shortest free path to the goal is from points around the rover, m: 16
      directions at each of two distances d, clipped to [-d, d], and -d where the rover cannot be;
    - ``movers``: the six that come nearest in the next two seconds, with the numbers of the sensor
      :class:`~rover_rl.envs.sensors.movers.Movers`, but true: x, y (m), velocity (m/s) in the base frame, radius (m);
    - ``friction``, ``chassis_mass``, ``motor_torque``: scale factors of the randomized dynamics;
    - ``latency``: delay of commands, control steps.

    ``robot`` determines the free space, or a function that returns that of a world.
    """

    def __init__(self, worlds: Worlds, robot: Robot | Callable[[World], Robot], device: torch.device) -> None:
        self._fields = GoalFields(worlds, robot)
        self._bearings = torch.arange(MAP_BEARINGS, device=device) * (2 * math.pi / MAP_BEARINGS)
        self._reach = torch.tensor(MAP_DISTANCES, device=device)

    def __call__(
        self, truth: Perception, movers: MoverField, world: Tensor, goal: Tensor, dynamics: Dynamics, latency: Tensor
    ) -> TensorDict:
        """Indices of worlds are int64 ``[N, 1]``, goals ``[N, 2]``, and delays of commands ``[N, 1]``."""
        rover = truth.rover
        self._fields.aim(world.flatten(), goal)
        path_distance = self._fields.along(truth.position)[0][:, None]
        entries = {
            "position": rover.position,
            "attitude": truth.euler,
            "velocities": torch.cat((rover.linear_velocity, rover.angular_velocity), -1),
            "target": target_info(truth.position, truth.yaw, goal),
            "path_distance": path_distance,
            "local_map": self._local_map(path_distance, truth),
            "movers": _nearest_movers(truth, movers),
            **{name: getattr(dynamics, name)[:, None] for name in ("friction", "chassis_mass", "motor_torque")},
            "latency": latency.to(torch.float32),
        }
        return unchecked_tensordict(entries, goal.shape[:1], goal.device)

    def _local_map(self, path_distance: Tensor, truth: Perception) -> Tensor:
        bearing = truth.yaw + self._bearings
        offset = self._reach[:, None, None] * torch.stack((bearing.cos(), bearing.sin()), -1)[:, None]
        points = truth.position[:, None] + offset.flatten(1, 2)
        distance, is_free = self._fields.along(points)
        reach = self._reach.repeat_interleave(MAP_BEARINGS)
        gain = torch.minimum((path_distance - distance).maximum(-reach), reach)
        return torch.where(is_free, gain, -reach)


def _nearest_movers(truth: Perception, movers: MoverField) -> Tensor:
    """The movers nearest to each rover, in its base frame, ``[N, NEAREST * NUMBERS]``."""
    if not movers.radius.shape[1]:
        return truth.yaw.new_zeros(len(truth.yaw), NEAREST * NUMBERS)
    state, found = movers.state, truth.yaw.new_empty(len(truth.yaw), NEAREST, NUMBERS)
    rows = torch.ones(len(found), dtype=torch.bool, device=found.device)
    given = state.position, state.velocity, movers.radius, movers.present
    put_in_order(found, rows, *given, truth.position, truth.yaw)
    return found.flatten(1)
