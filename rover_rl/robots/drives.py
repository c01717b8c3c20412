"""Drives: the joints that a command moves, the limits of the motion, and the matrix from commands to motor speeds.

A *command* is a twist: forward speed (m/s), counter-clockwise yaw rate (rad/s) and, for a drive that moves sideways,
speed to the left (m/s). :class:`~rover_rl.robots.kinematics.Kinematics` computes the drives of a batch of robots.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import numpy as np
import torch
from torch import Tensor


@dataclass(frozen=True)
class Wheels:
    """Geometry of the wheels of a robot, which are alike. Base frame: x forward, y left, z up; m."""

    hubs: tuple[tuple[float, float, float], ...]
    """Center of each wheel, in the order of :attr:`Drive.wheels`."""
    radius: float
    width: float
    """0 for a sphere, which touches level ground in a point."""
    steering: tuple[int, ...] = ()
    """Index in :attr:`Drive.steering` of the joint that carries each wheel, -1 without one. Empty if none steers."""


class Joints(NamedTuple):
    """Targets or readings of the joints of a batch of robots."""

    speeds: Tensor
    """Of the motors, each the mean of its wheels, ``[N, M]``, rad/s."""
    angles: Tensor
    """Of the steering joints, counter-clockwise, ``[N, S]``, rad."""


@dataclass(frozen=True, kw_only=True)
class Drive(ABC):
    """A drive: its joints, its kinematics and its limits.

    A subclass is a frozen dataclass, whose fields name its joints. It states :attr:`motors` and :meth:`matrix`.

    Raises:
        ValueError: if a limit is not positive and finite, a joint is named twice, or a pair has not two joints.
    """

    torque: float
    """Maximum torque of a motor on each of its wheels, N m."""
    max_linear_acceleration: float = 5.0
    """Of the commanded speed, m/s^2."""
    max_angular_acceleration: float = 4.0
    """Of the commanded yaw rate, rad/s^2."""
    max_speed: float = 1.0
    """Maximum absolute speed, m/s: of an action unless its configuration states another one, and of a real robot."""
    max_yaw_rate: float = 7.0
    """Maximum absolute yaw rate that is commanded, rad/s."""

    sideways: ClassVar[bool] = False
    """Whether commands and odometry have a third component, the speed to the left."""
    turns_in_place: ClassVar[bool] = True
    pairs: ClassVar[tuple[str, ...]] = ()
    """Fields that name a left and a right joint."""

    def __post_init__(self) -> None:
        for name in self.pairs:
            if len(joints := getattr(self, name)) != 2:
                raise ValueError(f"{name} of {type(self).__name__} must name a left and a right joint, got {joints}")
        for name in ("torque", "max_linear_acceleration", "max_angular_acceleration", "max_speed", "max_yaw_rate"):
            _check_positive(name, getattr(self, name))
        names = (*self.wheels, *self.steering)
        if len(set(names)) != len(names) or not all(self.motors):
            needs = f"each motor of a {type(self).__name__} drive must have a wheel, and each joint must be named once"
            raise ValueError(f"{needs}, got {names}")

    @property
    @abstractmethod
    def motors(self) -> tuple[tuple[str, ...], ...]:
        """Names of the wheel joints that each motor turns."""

    @property
    def passive(self) -> tuple[str, ...]:
        """Names of the wheel joints without a motor."""
        return ()

    @property
    def steering(self) -> tuple[str, ...]:
        """Names of the joints that turn wheels about +z, each of which carries one wheel."""
        return ()

    @property
    def wheels(self) -> tuple[str, ...]:
        """Names of all wheel joints: those of each motor, then those without one."""
        return (*(wheel for motor in self.motors for wheel in motor), *self.passive)

    @property
    def motor_of_wheel(self) -> tuple[int, ...]:
        """Index of the motor of each wheel; -1 without one."""
        return (*(index for index, motor in enumerate(self.motors) for _ in motor), *(-1 for _ in self.passive))

    @property
    def rollers(self) -> tuple[float | None, ...]:
        """Direction of the ideal roller of each wheel on the ground, rad from +x; ``None`` for a tire. Empty: no such.

        Such a wheel transfers force along the axle of its roller only, and moves freely across it.
        """
        return ()

    @abstractmethod
    def matrix(self, wheels: Wheels) -> Tensor:
        """Speed of each motor for each unit of the twist, ``[M, 2]``, or ``[M, 3]`` if it moves sideways."""

    def inverse(self, wheels: Wheels) -> Tensor:
        """Twist for each unit of the motors' speeds, ``[2, M]`` or ``[3, M]``: odometry without slip."""
        return torch.linalg.pinv(self.matrix(wheels))

    def min_radius(self, wheels: Wheels) -> float:
        """Smallest radius of a turn, m."""
        return 0.0

    def fastest_turn(self, wheels: Wheels) -> float:
        """Largest yaw rate, at any speed up to the largest one, rad/s."""
        radius = self.min_radius(wheels)
        return min(self.max_yaw_rate, self.max_speed / radius) if radius > 0 else self.max_yaw_rate

    def pivot(self, wheels: Wheels) -> float:
        """X of the line across the robot on which the centers of its turns lie, m."""
        return 0.0

    def check(self, wheels: Wheels) -> None:  # noqa: B027 - a drive without conditions has nothing to check
        """Raises a ``ValueError`` if the drive cannot move these wheels."""


@dataclass(frozen=True, kw_only=True)
class SkidSteer(Drive):
    """Drive with a motor for the wheels of each side. With one wheel a side, it is a differential drive.

    The wheels turn with ``(v -+ w track / 2) / r`` for the forward speed ``v`` and the yaw rate ``w``.
    """

    left: tuple[str, ...]
    right: tuple[str, ...]
    """Names of the joints of the wheels on each side."""
    separation: float | None = None
    """Effective distance between the left and right wheels in the kinematics, m. It differs from the distance in the
    URDF, which ``None`` takes, because the wheels slip in turns."""
    casters: tuple[str, ...] = ()
    """Names of the joints of wheels that hold the robot up without friction."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.separation is not None:
            _check_positive("separation", self.separation)

    @property
    def motors(self) -> tuple[tuple[str, ...], ...]:
        return self.left, self.right

    @property
    def passive(self) -> tuple[str, ...]:
        return self.casters

    @property
    def rollers(self) -> tuple[float | None, ...]:
        # A caster rolls ahead freely, and sideways on ideal rollers.
        return (*(None for _ in (*self.left, *self.right)), *(0.0 for _ in self.casters)) if self.casters else ()

    def check(self, wheels: Wheels) -> None:
        sides = [("left", 1)] * len(self.left) + [("right", -1)] * len(self.right)
        for name, hub, (side, sign) in zip(self.wheels, wheels.hubs, sides, strict=False):
            if not sign * hub[1] > 0:
                rule = "left wheels must be at y > 0, right wheels at y < 0"
                raise ValueError(f"{side} wheel {name!r} is at y = {hub[1]:g} m; {rule}")

    def track(self, wheels: Wheels) -> float:
        """Distance of left and right wheels in the kinematics, m: ``separation``, or that of the hubs."""
        if self.separation is not None:
            return self.separation
        left, driven = len(self.left), len(self.left) + len(self.right)
        sides = [hub[1] for hub in wheels.hubs[:driven]]
        return sum(sides[:left]) / left - sum(sides[left:]) / len(self.right)

    def matrix(self, wheels: Wheels) -> Tensor:
        half = self.track(wheels) / 2
        return torch.stack((torch.tensor(1 / wheels.radius).expand(2), torch.tensor((-half, half)) / wheels.radius), 1)

    def inverse(self, wheels: Wheels) -> Tensor:
        linear, angular = wheels.radius / 2, wheels.radius / self.track(wheels)
        return torch.tensor(((linear, linear), (-angular, angular)))


@dataclass(frozen=True, kw_only=True)
class Mecanum(Drive):
    """Omnidirectional drive with four mecanum wheels, each with a motor. The rollers are ideal.

    A wheel at ``(x, y)`` whose roller lies along the direction ``b`` turns with
    ``(v - w y + tan(b) (u + w x)) / r`` for the forward speed ``v``, yaw rate ``w`` and leftward speed ``u`` (K. Lynch
    and F. Park, *Modern Robotics*, 2017, section 13.2). The wheels form an X seen from above: ``b`` is -45 degrees for
    the front left and rear right wheels, 45 degrees for the others.
    """

    front: tuple[str, str]
    rear: tuple[str, str]
    """Names of the joints of the left and the right wheel."""

    sideways: ClassVar[bool] = True
    pairs: ClassVar[tuple[str, ...]] = ("front", "rear")

    @property
    def motors(self) -> tuple[tuple[str, ...], ...]:
        return tuple((wheel,) for wheel in (*self.front, *self.rear))

    @property
    def rollers(self) -> tuple[float, ...]:
        return (-math.pi / 4, math.pi / 4, math.pi / 4, -math.pi / 4)

    def check(self, wheels: Wheels) -> None:
        corners = ((1, 1), (1, -1), (-1, 1), (-1, -1))
        middle = [sum(hub[axis] for hub in wheels.hubs) / 4 for axis in (0, 1)]
        for name, hub, signs in zip(self.wheels, wheels.hubs, corners, strict=True):
            if not all(sign * (hub[axis] - middle[axis]) > 0 for axis, sign in enumerate(signs)):
                raise ValueError(f"wheel {name!r} is not at its corner: front wheels ahead, left wheels at the left")

    def matrix(self, wheels: Wheels) -> Tensor:
        tangents = map(math.tan, self.rollers)
        rows = [(1.0, t * x - y, t) for t, (x, y, _) in zip(tangents, wheels.hubs, strict=True)]
        return torch.tensor(rows) / wheels.radius


@dataclass(frozen=True, kw_only=True)
class Ackermann(Drive):
    """Drive of a car: the front wheels steer, and a differential drives the rear wheels.

    All wheels roll about one point on the line of the rear axle, at the signed curvature ``k = tan(a) / L`` for the
    steering angle ``a`` of the middle of the front axle and the wheelbase ``L``. A wheel at ``(x, y)`` from the middle
    of the rear axle steers by ``atan2(k x, 1 - k y)``, and a rear wheel turns with ``v (1 - k y) / r``. A command that
    asks for a sharper turn than the car can take steers as far as it can.
    """

    knuckles: tuple[str, str]
    """Names of the joints that turn the left and the right front wheel about +z."""
    front: tuple[str, str]
    rear: tuple[str, str]
    """Names of the joints of the left and the right wheel."""
    max_steering: float
    """Largest steering angle of the middle of the front axle, rad."""
    max_steering_rate: float = 3.0
    """Largest rate of that angle, rad/s."""

    turns_in_place: ClassVar[bool] = False
    pairs: ClassVar[tuple[str, ...]] = ("knuckles", "front", "rear")

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0 < self.max_steering < math.pi / 2:
            raise ValueError(f"max_steering must be between 0 and pi/2 rad, got {self.max_steering}")
        _check_positive("max_steering_rate", self.max_steering_rate)

    @property
    def motors(self) -> tuple[tuple[str, ...], ...]:
        return tuple((wheel,) for wheel in self.rear)

    @property
    def passive(self) -> tuple[str, ...]:
        return self.front

    @property
    def steering(self) -> tuple[str, ...]:
        return self.knuckles

    def wheelbase(self, wheels: Wheels) -> float:
        """Distance from the rear to the front axle, m."""
        rear, front = wheels.hubs[:2], wheels.hubs[2:]
        return (front[0][0] + front[1][0] - rear[0][0] - rear[1][0]) / 2

    def min_radius(self, wheels: Wheels) -> float:
        """Radius of the sharpest turn of the middle of the rear axle, m."""
        return self.wheelbase(wheels) / math.tan(self.max_steering)

    def pivot(self, wheels: Wheels) -> float:
        rear = wheels.hubs[:2]
        return (rear[0][0] + rear[1][0]) / 2

    def check(self, wheels: Wheels) -> None:
        if not self.wheelbase(wheels) > 0:
            raise ValueError(f"the front wheels {self.front} must be ahead of the rear wheels {self.rear}")
        for left, right in ((0, 1), (2, 3)):
            if not wheels.hubs[left][1] > wheels.hubs[right][1]:
                raise ValueError(f"wheel {self.wheels[left]!r} must be to the left of wheel {self.wheels[right]!r}")
        if wheels.steering != (-1, -1, 0, 1):
            raise ValueError(f"the steering joints {self.knuckles} must carry the front wheels {self.front}")
        if self.min_radius(wheels) <= max(abs(hub[1]) for hub in wheels.hubs):
            raise ValueError(f"max_steering of {self.max_steering:g} rad turns about a point between the wheels")

    def matrix(self, wheels: Wheels) -> Tensor:
        """Speeds of the rear wheels. Those of the front wheels, and their angles, are in ``Kinematics``."""
        return torch.tensor([[1.0, -y] for _, y, _ in wheels.hubs[:2]]) / wheels.radius


def _check_positive(name: str, value: float) -> None:
    if not 0 < value < math.inf:
        raise ValueError(f"{name} of a drive must be a positive number, got {value}")


def effective_track(points: np.ndarray, sides: Sequence[int], center: Sequence[float], width: float = 0.0) -> float:
    """Returns the distance of left and right wheels that slip in a turn in place, as odometry must take it, m.

    The wheels of a side turn at one speed, and each transfers Coulomb friction against its slip. In steady motion, the
    forces and the moment vanish, which minimizes the power that friction takes, a convex function of the velocity. For
    four thin wheels at the corners of a wheelbase L and a track T, the result is ``T (1 + (L / T)^2)``.

    Args:
        points: x and y of the contacts of the wheels, ``[W, 2]``, m.
        sides: 1 for a left wheel, -1 for a right one.
        center: x and y of the center of mass, m.
        width: width of the wheels, m. Each touches the ground at two points, ``width / sqrt(3)`` apart.

    Example:
        >>> corners = np.array([(0.2, 0.25), (-0.2, 0.25), (0.2, -0.25), (-0.2, -0.25)])
        >>> round(effective_track(corners, (1, 1, -1, -1), (0.0, 0.0)), 3)
        0.82
    """
    # On equal springs, the loads are linear in x and y.
    rows = np.column_stack((np.ones(len(points)), points))
    loads = np.maximum(rows @ np.linalg.pinv(rows.T @ rows) @ np.array((1.0, *center[:2])), 0.0)
    loads, signs = np.tile(loads / loads.sum() / 2, 2), np.tile(np.asarray(sides, dtype=float), 2)
    scale, half = float(np.abs(points[:, 1]).mean()), np.array((0.0, width / math.sqrt(12)))
    x, y = (np.concatenate([points - half, points + half]) / scale).T

    def power(velocity: np.ndarray) -> float:
        ahead, left, turn = velocity
        # The right wheels roll ahead with speed 1, the left ones back. Slip below 0.001 is rounded off.
        slip = ahead - turn * y + signs, left + turn * x
        return float(loads @ np.sqrt(slip[0] ** 2 + slip[1] ** 2 + 1e-3**2))

    # Importing it takes 0.2 seconds, and most programs do without.
    from scipy.optimize import minimize

    tolerances = {"xatol": 1e-6, "fatol": 1e-12}
    least = minimize(power, np.array((0.0, 0.0, 0.5)), method="Nelder-Mead", options=tolerances)
    return float(2 * scale / least.x[2])
