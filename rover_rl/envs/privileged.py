"""The privileged observation: what only a simulation knows, for critics and experts. Policies do not read it."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import TensorDict
from torch import Tensor

from rover_rl.envs.perception import Perception
from rover_rl.envs.task import target_info
from rover_rl.sims.base import Dynamics
from rover_rl.sims.robots import Robot
from rover_rl.sims.worlds import World
from rover_rl.sims.worlds.path_distance import PathDistances
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
"""Entries of the privileged observation, and the number of features of each."""


class PrivilegedObservation:
    """Computes the privileged observation.

    Its entries are float32 ``[N, k]``, unclipped: ``position`` (m), ``attitude`` (roll, pitch, yaw; rad),
    ``velocities`` (wheel odometry without noise; m/s, rad/s), ``target`` (distance in m and relative angle in rad),
    ``path_distance`` (distance to the goal along the shortest free path, m), ``friction``, ``chassis_mass`` and
    ``motor_torque`` (factors of the randomization), ``latency`` (delay of commands, control steps).

    Args:
        worlds: the world of each row.
        robot: the robot that the path must be wide enough for.
        device: device of the observation.
    """

    def __init__(self, worlds: Sequence[World], robot: Robot, device: torch.device) -> None:
        self._distances = PathDistances(worlds, robot, device)

    def __call__(self, truth: Perception, goal: Tensor, dynamics: Dynamics, latency: Tensor) -> TensorDict:
        """The observation, ``[N]``.

        Args:
            truth: the true state.
            goal: goals, ``[N, 2]``, m.
            dynamics: factors of the rovers, ``[N]`` each.
            latency: delays, ``[N, 1]``, control steps.
        """
        rover = truth.rover
        entries = {
            "position": rover.position,
            "attitude": truth.euler,
            "velocities": torch.cat((rover.linear_velocity, rover.angular_velocity), -1),
            "target": target_info(truth.position, truth.yaw, goal),
            "path_distance": self._distances(truth.position, goal),
            "friction": dynamics.friction[:, None],
            "chassis_mass": dynamics.chassis_mass[:, None],
            "motor_torque": dynamics.motor_torque[:, None],
            "latency": latency.to(torch.float32),
        }
        return unchecked_tensordict(entries, goal.shape[:1], goal.device)
