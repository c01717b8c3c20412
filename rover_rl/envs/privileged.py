"""Privileged observation: quantities that are known only in simulation, for critics and experts, not for policies."""

from __future__ import annotations

import torch
from tensordict import TensorDict
from torch import Tensor

from rover_rl.envs.perception import Perception
from rover_rl.envs.task import target_info
from rover_rl.sims.base import Dynamics
from rover_rl.sims.robots import Robot
from rover_rl.sims.worlds.path_distance import PathDistances
from rover_rl.sims.worlds.world import Worlds
from rover_rl.tensordicts import unchecked_tensordict

FEATURES = {
    "position": 3,
    "attitude": 3,
    "velocities": 2,
    "target": 2,
    "path_distance": 1,
    "friction": 1,
    "chassis_mass": 1,
    "motor_torque": 1,
    "latency": 1,
}
"""Entries of the privileged observation and their numbers of features."""


class PrivilegedObservation:
    """Computes the privileged observation.

    Its entries are float32 ``[N, k]`` and not clipped:

    - ``position``: position (x, y, z), m;
    - ``attitude``: roll, pitch and yaw, rad;
    - ``velocities``: wheel odometry without noise, m/s and rad/s;
    - ``target``: distance (m) and relative angle (rad) of the goal;
    - ``path_distance``: distance to the goal along the shortest free path, m;
    - ``friction``, ``chassis_mass``, ``motor_torque``: scale factors of the randomized dynamics;
    - ``latency``: delay of commands, control steps.

    Args:
        worlds: worlds of the environment, by index.
        robot: robot that determines the free space.
        device: device of the observation.
    """

    def __init__(self, worlds: Worlds, robot: Robot, device: torch.device) -> None:
        self._distances = PathDistances(worlds, robot, device)

    def __call__(
        self, truth: Perception, world: Tensor, goal: Tensor, dynamics: Dynamics, latency: Tensor
    ) -> TensorDict:
        """Returns the privileged observation, ``[N]``.

        Args:
            truth: true state of the rovers.
            world: index of each row's world, int64 ``[N, 1]``.
            goal: positions of the goals, ``[N, 2]``, m.
            dynamics: scale factors of the dynamics, ``[N]`` each.
            latency: delays of commands, ``[N, 1]``, control steps.
        """
        rover = truth.rover
        entries = {
            "position": rover.position,
            "attitude": truth.euler,
            "velocities": torch.cat((rover.linear_velocity, rover.angular_velocity), -1),
            "target": target_info(truth.position, truth.yaw, goal),
            "path_distance": self._distances(world, truth.position, goal),
            "friction": dynamics.friction[:, None],
            "chassis_mass": dynamics.chassis_mass[:, None],
            "motor_torque": dynamics.motor_torque[:, None],
            "latency": latency.to(torch.float32),
        }
        return unchecked_tensordict(entries, goal.shape[:1], goal.device)
