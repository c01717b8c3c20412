"""``Fleet``: the robots that the rows of a batch may have, and the one that each row has."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

import torch
from torch import Tensor

from rover_rl.robots.robot import Robot

MAX_ROBOTS = 1024
"""Maximum number of robots in a fleet. All of them are in memory."""


def largest_of(robots: Iterable[Robot]) -> Robot:
    """Returns the robot with the largest radius, whose free space is that of all, and of these the widest turn."""
    return max(robots, key=lambda robot: (robot.radius, robot.drive.min_radius(robot.wheels)))


class Fleet:
    """Robots of the rows of a batch.

    Those who hold data of robots keep them by index, ``[K, ...]``, and look them up by ``index``.

    Args:
        robots: the K robots that there are.
        index: index of each row's robot among them, int64 ``[N]``.

    Attributes:
        robots: the K robots.
        index: index of each row's robot. A change replaces the tensor.

    Raises:
        ValueError: if there are no robots or too many, or their sensors differ.

    Example:
        >>> from rover_rl.robots import get_robot
        >>> fleet = Fleet([get_robot("any:0"), get_robot("any:1")], torch.tensor([0, 1, 1]))
        >>> len(fleet), fleet[2].name
        (3, 'any:1')
    """

    def __init__(self, robots: Sequence[Robot], index: Tensor) -> None:
        if not 1 <= len(robots) <= MAX_ROBOTS:
            raise ValueError(f"a batch can have 1 to {MAX_ROBOTS} different robots, got {len(robots)}")
        for robot in robots:
            if robot.sensors != robots[0].sensors:
                raise ValueError(
                    f"robots of one batch must have the same sensors, {robots[0].name!r} and {robot.name!r} differ"
                )
        self.robots, self.index = tuple(robots), index

    @classmethod
    def of(cls, robot: Robot | Fleet, count: int, device: torch.device | str | None = None) -> Fleet:
        """Returns the fleet of ``count`` rows with the same robot. Returns a fleet unchanged."""
        if isinstance(robot, Fleet):
            return robot
        return cls((robot,), torch.zeros(count, dtype=torch.int64, device=device))

    @property
    def largest(self) -> Robot:
        """The robot that needs the most space: see ``largest_of``."""
        return largest_of(self.robots)

    def __len__(self) -> int:
        """Number of rows."""
        return len(self.index)

    def __getitem__(self, row: int) -> Robot:
        """Returns the robot of a row."""
        return self.robots[int(self.index[row])]

    def __iter__(self) -> Iterator[Robot]:
        """Iterates over the robots of all rows."""
        return map(self.robots.__getitem__, self.index.tolist())

    def table(self, numbers: Callable[[Robot], Any], dtype: torch.dtype = torch.float32) -> Tensor:
        """Returns numbers of each robot on the device of the rows, ``[K, ...]``."""
        return torch.tensor([numbers(robot) for robot in self.robots], dtype=dtype, device=self.index.device)
