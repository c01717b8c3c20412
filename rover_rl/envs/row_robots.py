"""The robot of each row of a batch."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from rover_rl.rng import random_bits, to_index
from rover_rl.robots import Robot
from rover_rl.robots.fleet import Fleet

_ROBOT = 17
"""Stream of random numbers."""


class RowRobots:
    """The robot of each row of a batch. Each episode draws one of those that drive in its world, all equally likely.

    The draw depends on the seed of the row, the number of the episode and its world only.

    Args:
        robots: robots that episodes draw from.
        keys: random keys of the first episodes, ``[N, 1]``.
        choices: first robot and number of robots that each row chooses from, int64 ``[N, 2]``.

    Attributes:
        fleet: robot of each row, for those who hold data of robots.
        keys: random keys of the next episodes in place of those of the environment, int64 ``[N, 1]``. ``None``: those
            of the environment.
        limits: largest speed, yaw rate and speed to the left of each robot, ``[K, 3]``, m/s and rad/s.
    """

    def __init__(self, robots: Sequence[Robot], keys: Tensor, choices: Tensor) -> None:
        self.fleet = Fleet(robots, _drawn(keys, choices))
        self.keys: Tensor | None = None
        self.limits = self.fleet.table(lambda robot: [getattr(robot.drive, name) for name in _LIMITS])

    @property
    def are_several(self) -> bool:
        """Whether there are different robots."""
        return len(self.fleet.robots) > 1

    def draw(self, mask: Tensor, keys: Tensor, choices: Tensor) -> None:
        """Draws the robots of new episodes.

        Args:
            mask: rows that begin an episode, bool ``[N, 1]``.
            keys: random keys of the episodes, ``[N, 1]``.
            choices: first robot and number of robots that each row chooses from, int64 ``[N, 2]``.
        """
        keys = keys if self.keys is None else self.keys
        self.fleet.index = torch.where(mask.squeeze(-1), _drawn(keys, choices), self.fleet.index)

    def limited(self, command: Tensor) -> Tensor:
        """Returns commands within the limits of the robots, ``[N, 2]`` or ``[N, 3]``. Those of one robot stay."""
        if not self.are_several:
            return command
        limits = self.limits[self.fleet.index, : command.shape[-1]]
        return torch.clamp(command, -limits, limits)


def _drawn(keys: Tensor, choices: Tensor) -> Tensor:
    """Returns the index of the robot that each episode draws, int64 ``[N]``."""
    return choices[:, 0] + to_index(random_bits(keys, _ROBOT, 0, 1), choices[:, 1:]).squeeze(-1)


_LIMITS = ("max_speed", "max_yaw_rate", "max_speed")
