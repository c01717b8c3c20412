"""Ackermann: two front wheels steer, and all wheels roll about one center of rotation."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import ClassVar

import torch
from torch import Tensor

from rover_rl.robots.drives.base import Drive, Equations, Joints, Wheels
from rover_rl.rotations import angle_of


@dataclass(frozen=True, kw_only=True)
class Ackermann(Drive):
    """Drive of a car: the front wheels steer, and a differential drives the rear wheels.

    All wheels roll about one point on the line of the rear axle, at the signed curvature ``k = tan(a) / L`` for the
    steering angle ``a`` of the middle of the front axle and the wheelbase ``L``. A wheel at ``(x, y)`` from the middle
    of the rear axle steers by ``atan2(k x, 1 - k y)``, and a rear wheel turns with ``v (1 - k y) / r``. A command that
    asks for a sharper turn than the car can take steers as far as it can.

    Args:
        knuckles: names of the joints that turn the left and the right front wheel about +z.
        front: names of the joints of the left and the right front wheel.
        rear: names of the joints of the left and the right rear wheel.
        max_steering: largest steering angle of the middle of the front axle, rad.
        max_steering_rate: largest rate of that angle, rad/s.

    Raises:
        ValueError: as :class:`Drive`, or if a steering limit is out of range.
    """

    knuckles: tuple[str, str]
    front: tuple[str, str]
    rear: tuple[str, str]
    max_steering: float
    max_steering_rate: float = 3.0

    turns_in_place: ClassVar[bool] = False
    pairs: ClassVar[tuple[str, ...]] = ("knuckles", "front", "rear")

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0 < self.max_steering < math.pi / 2:
            raise ValueError(f"max_steering must be between 0 and pi/2 rad, got {self.max_steering}")
        if not 0 < self.max_steering_rate < math.inf:
            raise ValueError(f"max_steering_rate must be a positive number, got {self.max_steering_rate}")

    @property
    def motors(self) -> tuple[tuple[str, ...], ...]:
        """Names of the rear wheel joints: each has its own speed."""
        return tuple((wheel,) for wheel in self.rear)

    @property
    def passive(self) -> tuple[str, ...]:
        """Names of the front wheel joints."""
        return self.front

    @property
    def steering(self) -> tuple[str, ...]:
        """Names of the joints that turn the front wheels."""
        return self.knuckles

    def wheelbase(self, wheels: Wheels) -> float:
        """Returns the distance from the rear to the front axle, m."""
        rear, front = wheels.hubs[:2], wheels.hubs[2:]
        return (front[0][0] + front[1][0] - rear[0][0] - rear[1][0]) / 2

    def min_radius(self, wheels: Wheels) -> float:
        """Returns the radius of the sharpest turn of the middle of the rear axle, m."""
        return self.wheelbase(wheels) / math.tan(self.max_steering)

    def pivot(self, wheels: Wheels) -> float:
        """Returns x of the rear axle, m."""
        rear = wheels.hubs[:2]
        return (rear[0][0] + rear[1][0]) / 2

    def check(self, wheels: Wheels) -> None:
        """Checks that the front wheels are ahead of the rear wheels, and left ones to the left."""
        if not self.wheelbase(wheels) > 0:
            raise ValueError(f"the front wheels {self.front} must be ahead of the rear wheels {self.rear}")
        for left, right in ((0, 1), (2, 3)):
            if not wheels.hubs[left][1] > wheels.hubs[right][1]:
                raise ValueError(f"wheel {self.wheels[left]!r} must be to the left of wheel {self.wheels[right]!r}")
        if wheels.steering != (-1, -1, 0, 1):
            raise ValueError(f"the steering joints {self.knuckles} must carry the front wheels {self.front}")
        if self.min_radius(wheels) <= max(abs(hub[1]) for hub in wheels.hubs):
            raise ValueError(f"max_steering of {self.max_steering:g} rad turns about a point between the wheels")

    def equations(self, wheels: Wheels, dt: float, device: torch.device | str | None = None) -> AckermannEquations:
        """Returns the equations of the drive: see :meth:`Drive.equations`."""
        return _equations(self, wheels, dt, torch.device(device or "cpu"))

    def advance(self, set_point: Tensor, command: Tensor, wheels: Wheels, dt: float) -> Tensor:
        """Returns the speed (m/s) and steering angle (rad) after ``dt``, ``[N, 2]``."""
        return self.equations(wheels, dt, command.device).advance(set_point, command)

    def targets(self, before: Tensor, after: Tensor, wheels: Wheels) -> Joints:
        """Returns the speeds of the rear wheels ``[N, 2]`` and the angles of the front wheels ``[N, 2]``."""
        return self.equations(wheels, 0.0, before.device).targets(before, after)

    def odometry(self, joints: Joints, wheels: Wheels) -> Tensor:
        """Returns the mean speed of the rear wheels, and the yaw rate by the angles of the front wheels, ``[N, 2]``."""
        return self.equations(wheels, 0.0, joints.speeds.device).odometry(joints)


@dataclass(frozen=True)
class AckermannEquations(Equations):
    """Equations of a car: see :class:`Equations`.

    Attributes:
        wheelbase: distance from the rear to the front axle, m.
        radius: radius of a wheel, m.
        sides: y of the left and right rear wheels, and of the left and right front wheels, m.
        max_steering: largest steering angle of the middle of the front axle, rad.
        gain: largest change of the speed in a step, m/s.
        turn: largest change of the steering angle in a step, rad.
    """

    wheelbase: Tensor
    radius: Tensor
    sides: Tensor
    max_steering: Tensor
    gain: Tensor
    turn: Tensor

    def advance(self, set_point: Tensor, command: Tensor) -> Tensor:
        """Returns the speed (m/s) and steering angle (rad) after a step, ``[N, 2]``."""
        speed, angle = set_point.split(1, -1)
        desired, yaw_rate = command.split(1, -1)
        # In reverse, the same yaw rate needs the opposite angle.
        side = torch.where(desired < 0, -yaw_rate, yaw_rate)
        # Its bits do not depend on the size of the batch, as those of torch.atan2 do.
        wanted = angle_of(torch.stack((desired.abs(), side * self.wheelbase), -1))
        wanted = wanted.clamp(-self.max_steering, self.max_steering)
        steps = (desired - speed).clamp(-self.gain, self.gain), (wanted - angle).clamp(-self.turn, self.turn)
        return torch.cat((speed + steps[0], angle + steps[1]), -1)

    def targets(self, before: Tensor, after: Tensor) -> Joints:
        """Returns the speeds of the rear wheels ``[N, 2]`` and the angles of the front wheels ``[N, 2]``."""
        speed = (before[:, :1] + after[:, :1]) * 0.5
        curvature = after[:, 1:].tan() / self.wheelbase
        inside = 1 - curvature * self.sides
        angles = angle_of(torch.stack((inside[:, 2:], (curvature * self.wheelbase).expand(-1, 2)), -1))
        return Joints(speed * inside[:, :2] / self.radius, angles)

    def odometry(self, joints: Joints) -> Tensor:
        """Returns the mean speed of the rear wheels, and the yaw rate by the angles of the front wheels, ``[N, 2]``."""
        # The mean of two, in the same order for any layout of the batch.
        speed = (joints.speeds[:, :1] + joints.speeds[:, 1:]) / 2 * self.radius
        tangents = joints.angles.tan()
        curvatures = tangents / (self.wheelbase + self.sides[..., 2:] * tangents)
        return torch.cat((speed, speed * ((curvatures[:, :1] + curvatures[:, 1:]) / 2)), -1)


@lru_cache(maxsize=64)
def _equations(drive: Ackermann, wheels: Wheels, dt: float, device: torch.device) -> AckermannEquations:
    """Copies the numbers of the equations to a device once: a copy from the host waits for the device."""
    return AckermannEquations(
        wheelbase=torch.tensor([drive.wheelbase(wheels)], device=device),
        radius=torch.tensor([wheels.radius], device=device),
        sides=torch.tensor([hub[1] for hub in wheels.hubs], device=device),
        max_steering=torch.tensor([drive.max_steering], device=device),
        gain=torch.tensor([drive.max_linear_acceleration * dt], device=device),
        turn=torch.tensor([drive.max_steering_rate * dt], device=device),
    )
