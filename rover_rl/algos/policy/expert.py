"""PrivilegedExpert: planner that uses the map and the pose, for imitation in training.

Example:
    >>> env = make_env(world_n="maze", num_envs=2, seed=0)
    >>> expert = PrivilegedExpert(env.worlds, env.robot)
    >>> expert.action(env.reset()).shape
    torch.Size([2, 2])
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from tensordict import TensorDictBase
from torch import Tensor

from rover_rl.algos.policy.baselines import drive_towards
from rover_rl.envs.transforms.path_reward import CAUTION, goal_of
from rover_rl.sims.robots import Robot
from rover_rl.sims.rotations import wrap_angle
from rover_rl.sims.worlds import World, free_space
from rover_rl.sims.worlds.path_distance import PathDistance, PerWorld

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
    :class:`~rover_rl.algos.config.PPOConfig`. Observations must contain ``pose``, ``imu``, ``target`` and ``lidar``.

    Args:
        worlds: world of each row of the batch.
        robot: robot for which the path must be wide enough.
        device: device of the observations; ``None``: the CPU.
    """

    def __init__(self, worlds: Sequence[World], robot: Robot, device: torch.device | str | None = None) -> None:
        self._by_world = PerWorld(worlds, lambda world: _Headings(world, robot, device), device)

    def action(self, observation: TensorDictBase) -> Tensor:
        """Returns actions ``[N, ..., 2]`` for observations ``[N, ...]``: forward speed (m/s), heading offset (rad)."""
        position, yaw = observation["pose"][..., :2], observation["imu"][..., 2:]
        direction = self._by_world(_Headings.best, position, goal_of(observation))
        distance, bearing = observation["target"].split(1, -1)
        heading = torch.where(distance < NEAR, bearing, wrap_angle(direction - yaw))
        return drive_towards(heading.flatten(0, -2), observation["lidar"].flatten(0, -2)).unflatten(
            0, heading.shape[:-1]
        )


class _Headings:
    """Chooses the heading with the shortest path to the goal, in one world."""

    def __init__(self, world: World, robot: Robot, device: torch.device | str | None) -> None:
        self._distance = PathDistance(world, robot, device, CAUTION)
        self._space = free_space(world, robot).to(device)
        angles = torch.arange(DIRECTIONS, device=device) * (2 * math.pi / DIRECTIONS)
        self._angles, self._directions = angles, torch.stack((angles.cos(), angles.sin()), -1)

    def best(self, position: Tensor, goal: Tensor) -> Tensor:
        """Returns the best heading in the world frame for positions and goals ``[N, 2]``: ``[N, 1]``, rad."""
        anchor = self._distance.anchor(goal)[:, None]
        length = position.new_zeros(len(anchor), DIRECTIONS)
        for distance in LOOK_AHEAD:
            point = position[:, None] + distance * self._directions
            length += self._distance.to_anchor(anchor, point) + BLOCKED * ~self._space.contains(point)
        return self._angles[length.argmin(-1, keepdim=True)]
