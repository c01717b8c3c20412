"""PrivilegedExpert: planner that uses the map and the pose, for imitation in training.

Example:
    >>> env = make_env(world_n="maze", num_envs=2, seed=0)
    >>> expert = PrivilegedExpert(env.pool, env.robot)
    >>> expert.action(env.reset()).shape
    torch.Size([2, 2])
"""

from __future__ import annotations

import math

import torch
from tensordict import TensorDictBase
from torch import Tensor

from rover_rl.algos.policy.baselines import drive_towards
from rover_rl.envs.transforms.path_reward import CAUTION, goal_of, world_of
from rover_rl.sims.robots import Robot
from rover_rl.sims.rotations import wrap_angle
from rover_rl.sims.worlds.path_distance import PathDistances
from rover_rl.sims.worlds.world import Worlds

DIRECTIONS = 32
"""Number of candidate headings."""
LOOK_AHEAD = (0.3, 0.6)
"""Distances at which each candidate heading is evaluated, m."""
BLOCKED = 50.0
"""Penalty on the path length for a point that is not free, m."""
NEAR = 0.8
"""Distance to the goal below which the expert drives straight to it, m."""


class PrivilegedExpert:
    """Expert that follows the shortest free path, which it computes from the map and the pose.

    A policy without the map and the pose can imitate it: see ``imitation`` in
    :class:`~rover_rl.algos.config.PPOConfig`. Observations must contain ``pose``, ``imu``, ``target``, ``lidar`` and
    ``outcome``.

    Args:
        worlds: worlds, by index. Usually ``RoverEnv.pool``.
        robot: robot for which the path must be wide enough.
        device: device of the observations; ``None``: the CPU.
    """

    def __init__(self, worlds: Worlds, robot: Robot, device: torch.device | str | None = None) -> None:
        self._distances = PathDistances(worlds, robot, device, CAUTION)
        angles = torch.arange(DIRECTIONS, device=device) * (2 * math.pi / DIRECTIONS)
        self._angles, self._directions = angles, torch.stack((angles.cos(), angles.sin()), -1)

    def action(self, observation: TensorDictBase) -> Tensor:
        """Returns actions ``[N, ..., 2]`` for observations ``[N, ...]``: forward speed (m/s), heading offset (rad)."""
        shape = observation.batch_size
        rows = observation.select("pose", "imu", "target", "lidar", "outcome").flatten()
        direction = self._best_heading(world_of(rows)[:, 0], rows["pose"][:, :2], goal_of(rows))
        distance, bearing = rows["target"].split(1, -1)
        heading = torch.where(distance < NEAR, bearing, wrap_angle(direction - rows["imu"][:, 2:]))
        return drive_towards(heading, rows["lidar"]).reshape(*shape, 2)

    def _best_heading(self, world: Tensor, position: Tensor, goal: Tensor) -> Tensor:
        """Returns the heading with the shortest path to the goal, in the world frame, ``[M, 1]``, rad.

        Args:
            world: index of each row's world, int64 ``[M]``.
            position: positions, ``[M, 2]``, m.
            goal: goals, ``[M, 2]``, m.
        """
        fields = self._distances.fields(world, goal)
        length = position.new_zeros(len(position), DIRECTIONS)
        for distance in LOOK_AHEAD:
            path, is_free = self._distances.along(fields, position[:, None] + distance * self._directions)
            length += path + BLOCKED * ~is_free
        return self._angles[length.argmin(-1, keepdim=True)]
