"""``Fleet``: the robots that the rows of a batch may have, and the one that each row has."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from rover_rl.robots.robot import Robot

MAX_ROBOTS = 1024
"""Maximum number of robots in a fleet. All of them are in memory."""


def largest_of(robots: Iterable[Robot]) -> Robot:
    """Returns the robot with the largest radius, whose free space is that of all, and of these the widest turn."""
    return max(robots, key=lambda robot: (robot.radius, robot.drive.min_radius(robot.wheels)))


class Fleet:
    """Robots of the rows of a batch. Those who hold data of robots keep them by index, ``[K, ...]``.

    Args:
        robots: the K robots that there are.
        index: index of each row's robot among them, int64 ``[N]``. A change replaces the tensor.

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
        """The robot that needs the most space."""
        return largest_of(self.robots)

    def __len__(self) -> int:
        """Number of rows."""
        return len(self.index)

    def __getitem__(self, row: int) -> Robot:
        return self.robots[int(self.index[row])]

    def __iter__(self) -> Iterator[Robot]:
        return map(self.robots.__getitem__, self.index.tolist())

    def table(self, numbers: Callable[[Robot], Any], dtype: torch.dtype = torch.float32) -> Tensor:
        """Returns numbers of each robot on the device of the rows, ``[K, ...]``."""
        return torch.tensor([numbers(robot) for robot in self.robots], dtype=dtype, device=self.index.device)


class MassTable:
    """Mass properties of K robots, copied to a device once: a copy from the host waits for the device.

    Attributes:
        chassis_mass: mass of the chassis of each robot, ``[K]``, kg, float64.
    """

    def __init__(self, robots: Sequence[Robot], device: torch.device | str | None = None) -> None:
        counts = [len(robot.wheels.hubs) for robot in robots]
        hubs = [np.array(robot.wheels.hubs) for robot in robots]
        turns = np.array([np.diag((robot.wheel.inertia[0][0], 0.0, robot.wheel.inertia[0][0])) for robot in robots])
        # A wheel that a robot lacks has no mass.
        weights = np.array([[float(wheel < count) for wheel in range(max(counts))] for count in counts])
        pairs = [*zip(robots, hubs, strict=True)]
        arrays = {
            "mass": [robot.chassis.mass for robot in robots],
            "center": [robot.chassis.center for robot in robots],
            "inertia": [robot.chassis.inertia for robot in robots],
            "wheels_mass": [len(own) * robot.wheel.mass for robot, own in pairs],
            "wheels_moment": [robot.wheel.mass * torch.from_numpy(own).sum(0).numpy() for robot, own in pairs],
            "hubs": [np.pad(own, ((0, max(counts) - len(own)), (0, 0))) for own in hubs],
            "wheel": np.array([robot.wheel.mass for robot in robots])[:, None] * weights,
            "turn": turns[:, None] * weights[:, :, None, None],
        }
        self._tensors = {name: torch.tensor(np.array(array, dtype=float)).to(device) for name, array in arrays.items()}
        self.chassis_mass = self._tensors["mass"]

    def total(self, chassis_mass: Tensor, index: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Returns the mass ``[N]``, center of mass ``[N, 3]`` and inertia about it ``[N, 3, 3]`` of whole rovers.

        ``index [N]`` is each one's robot. The inertia of a chassis scales with its mass, ``chassis_mass [N]``, float64.
        That of wheels about their axles is left out, as the spin of a wheel is a state of its own.
        """
        own = {name: values[index] for name, values in self._tensors.items()}
        mass = chassis_mass + own["wheels_mass"]
        center = (chassis_mass[:, None] * own["center"] + own["wheels_moment"]) / mass[:, None]
        inertia = (chassis_mass / own["mass"])[:, None, None] * own["inertia"]
        inertia = inertia + _parallel_axis(chassis_mass, own["center"] - center)
        for wheel in range(own["hubs"].shape[1]):
            offset = own["hubs"][:, wheel] - center
            inertia = inertia + own["turn"][:, wheel] + _parallel_axis(own["wheel"][:, wheel], offset)
        return mass, center, inertia


def _parallel_axis(mass: Tensor, offset: Tensor) -> Tensor:
    """Inertia of point masses ``[N]`` at offsets ``[N, 3]``, ``m (|r|^2 1 - r r^T)`` (parallel axis theorem)."""
    square = (offset**2).sum(-1)[:, None, None] * torch.eye(3, dtype=mass.dtype, device=mass.device)
    return mass[:, None, None] * (square - offset[:, :, None] * offset[:, None, :])
