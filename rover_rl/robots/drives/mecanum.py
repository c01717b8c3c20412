"""Mecanum: four wheels with rollers at 45 degrees, with which a robot moves in any direction."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import ClassVar

import torch
from torch import Tensor

from rover_rl.robots.drives.base import Drive, Joints, Wheels


@dataclass(frozen=True, kw_only=True)
class Mecanum(Drive):
    """Omnidirectional drive with four mecanum wheels, each with a motor. The rollers are ideal.

    A wheel at ``(x, y)`` whose roller lies along the direction ``b`` turns with
    ``(v - w y + tan(b) (u + w x)) / r`` for the forward speed ``v``, yaw rate ``w`` and leftward speed ``u`` (K. Lynch
    and F. Park, *Modern Robotics*, 2017, section 13.2). The wheels form an X seen from above: ``b`` is -45 degrees for
    the front left and rear right wheels, 45 degrees for the others.

    Args:
        front: names of the joints of the left and the right front wheel.
        rear: names of the joints of the left and the right rear wheel.
    """

    front: tuple[str, str]
    rear: tuple[str, str]

    sideways: ClassVar[bool] = True
    set_point_size: ClassVar[int] = 3
    pairs: ClassVar[tuple[str, ...]] = ("front", "rear")

    @property
    def motors(self) -> tuple[tuple[str, ...], ...]:
        """Names of the wheel joints, a motor each."""
        return tuple((wheel,) for wheel in (*self.front, *self.rear))

    @property
    def rollers(self) -> tuple[float, ...]:
        """Direction of the roller on the ground for each wheel, rad from +x."""
        return (-math.pi / 4, math.pi / 4, math.pi / 4, -math.pi / 4)

    def check(self, wheels: Wheels) -> None:
        """Checks that each wheel is at its corner."""
        corners = ((1, 1), (1, -1), (-1, 1), (-1, -1))
        middle = [sum(hub[axis] for hub in wheels.hubs) / 4 for axis in (0, 1)]
        for name, hub, signs in zip(self.wheels, wheels.hubs, corners, strict=True):
            if not all(sign * (hub[axis] - middle[axis]) > 0 for axis, sign in enumerate(signs)):
                raise ValueError(f"wheel {name!r} is not at its corner: front wheels ahead, left wheels at the left")

    def advance(self, set_point: Tensor, command: Tensor, wheels: Wheels, dt: float) -> Tensor:
        """Returns the twist after ``dt``, limited in acceleration, ``[N, 3]``."""
        linear, angular = self.max_linear_acceleration * dt, self.max_angular_acceleration * dt
        limit = command.new_tensor((linear, angular, linear))
        return set_point + torch.clamp(command - set_point, -limit, limit)

    def targets(self, before: Tensor, after: Tensor, wheels: Wheels) -> Joints:
        """Returns the wheel speeds of the mean twist, ``[N, 4]``."""
        speeds = _product(_matrix(self.rollers, wheels, before.device), (before + after) * 0.5)
        return Joints(speeds, speeds[:, :0])

    def odometry(self, joints: Joints, wheels: Wheels) -> Tensor:
        """Returns the twist that fits the four wheel speeds best, ``[N, 3]``."""
        return _product(_inverse(self.rollers, wheels, joints.speeds.device), joints.speeds)


def _product(matrix: Tensor, vectors: Tensor) -> Tensor:
    """Returns a matrix ``[k, n]`` times each of ``vectors [N, n]``: ``[N, k]``.

    Unlike those of a matrix product, its bits do not depend on the size of the batch.
    """
    result = vectors[:, :1] * matrix[:, 0]
    for column in range(1, matrix.shape[1]):
        result = result + vectors[:, column : column + 1] * matrix[:, column]
    return result


@lru_cache(maxsize=16)
def _matrix(rollers: tuple[float, ...], wheels: Wheels, device: torch.device) -> Tensor:
    """Returns the wheel speeds per unit of forward speed, yaw rate and leftward speed, ``[4, 3]``."""
    rows = [(1.0, math.tan(b) * x - y, math.tan(b)) for b, (x, y, _) in zip(rollers, wheels.hubs, strict=True)]
    return torch.tensor(rows, device=device) / wheels.radius


@lru_cache(maxsize=16)
def _inverse(rollers: tuple[float, ...], wheels: Wheels, device: torch.device) -> Tensor:
    """Returns the twist per unit of wheel speed that fits best, ``[3, 4]``."""
    return torch.linalg.pinv(_matrix(rollers, wheels, device))
