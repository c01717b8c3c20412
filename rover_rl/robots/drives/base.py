"""``Drive``: what turns commands into the motion of joints, and the motion of joints into odometry."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, NamedTuple

import torch
from torch import Tensor


@dataclass(frozen=True)
class Wheels:
    """Geometry of the wheels of a robot, which are alike. Base frame: x forward, y left, z up; m.

    Attributes:
        hubs: center ``(x, y, z)`` of each wheel, in the order of :attr:`Drive.wheels`.
        radius: radius of a wheel.
        width: width of a wheel; 0 for a sphere, which touches level ground in a point.
        steering: index in :attr:`Drive.steering` of the joint that carries each wheel, or -1 without one. Empty if no
            wheel steers.
    """

    hubs: tuple[tuple[float, float, float], ...]
    radius: float
    width: float
    steering: tuple[int, ...] = ()


class Joints(NamedTuple):
    """Targets or readings of the joints of a batch of robots.

    Attributes:
        speeds: speed of each motor, the mean of its wheels, ``[N, M]``, rad/s.
        angles: angle of each steering joint, counter-clockwise, ``[N, S]``, rad.
    """

    speeds: Tensor
    angles: Tensor


@dataclass(frozen=True)
class Equations(ABC):
    """Equations of a kind of drive, whose fields are the numbers in them: float32 ``[k]`` for one robot.

    Those of several robots are stacked and chosen by row, ``[N, k]`` each, so that a batch of different robots is
    computed at once. The methods are those of :class:`Drive`, for the wheels and the step that the numbers are of.
    """

    def stacked_with(self, others: Sequence[Equations]) -> Equations:
        """Returns the equations of several robots, ``[1 + len(others), k]`` each: this one and ``others``."""
        names = vars(self)
        return replace(self, **{name: torch.stack([vars(each)[name] for each in (self, *others)]) for name in names})

    def of_rows(self, index: Tensor) -> Equations:
        """Returns the equations of rows, each with those of the robot at its index (int64 ``[N]``) of the stack."""
        return replace(self, **{name: numbers[index] for name, numbers in vars(self).items()})

    @abstractmethod
    def advance(self, set_point: Tensor, command: Tensor) -> Tensor:
        """Returns the set point after a step: see :meth:`Drive.advance`."""

    @abstractmethod
    def targets(self, before: Tensor, after: Tensor) -> Joints:
        """Returns the targets of the joints in a step: see :meth:`Drive.targets`."""

    @abstractmethod
    def odometry(self, joints: Joints) -> Tensor:
        """Returns the twist that the joints report: see :meth:`Drive.odometry`."""


@dataclass(frozen=True, kw_only=True)
class Drive(ABC):
    """A drive: its joints, its kinematics and its limits.

    A *command* is a twist: forward speed (m/s), counter-clockwise yaw rate (rad/s) and, for a drive that moves
    sideways, speed to the left (m/s). A *set point* is what the drive holds between two commands, usually the
    twist that it has reached. A subclass is a frozen dataclass, whose fields name its joints and state its limits. All
    methods are batched.

    Args:
        torque: maximum torque of a motor on each of its wheels, N m.
        max_linear_acceleration: maximum acceleration of the commanded speed, m/s^2.
        max_angular_acceleration: maximum acceleration of the commanded yaw rate, rad/s^2.
        max_speed: maximum absolute speed, m/s: that of an action unless its configuration states another one, and of
            the commands to a real robot.
        max_yaw_rate: maximum absolute yaw rate that is commanded, rad/s.

    Attributes:
        sideways: whether commands and odometry have a third component, the speed to the left.
        turns_in_place: whether the robot turns without driving.
        set_point_size: number of components of a set point.
        pairs: fields that name a left and a right joint.

    Raises:
        ValueError: if a limit is not positive and finite, a joint is named twice, or a pair has not two joints.
    """

    torque: float
    max_linear_acceleration: float = 5.0
    max_angular_acceleration: float = 4.0
    max_speed: float = 1.0
    max_yaw_rate: float = 7.0

    sideways: ClassVar[bool] = False
    turns_in_place: ClassVar[bool] = True
    set_point_size: ClassVar[int] = 2
    pairs: ClassVar[tuple[str, ...]] = ()

    def __post_init__(self) -> None:
        for name in self.pairs:
            if len(joints := getattr(self, name)) != 2:
                raise ValueError(f"{name} of {type(self).__name__} must name a left and a right joint, got {joints}")
        for name in ("torque", "max_linear_acceleration", "max_angular_acceleration", "max_speed", "max_yaw_rate"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0):
                raise ValueError(f"{name} of a drive must be a positive number, got {value}")
        names = (*self.wheels, *self.steering)
        if len(set(names)) != len(names) or not all(self.motors):
            raise ValueError(
                f"each motor of a {type(self).__name__} drive must have a wheel, and each joint must be named once, "
                f"got {names}"
            )

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
        """Direction of the roller of each wheel on the ground, rad from +x; ``None`` for a tire. Empty without rollers.

        A wheel with ideal rollers transfers force along the axle of its roller only, and moves freely across it.
        """
        return ()

    def min_radius(self, wheels: Wheels) -> float:
        """Returns the smallest radius of a turn, m."""
        return 0.0

    def fastest_turn(self, wheels: Wheels) -> float:
        """Returns the largest yaw rate, at any speed up to the largest one, rad/s."""
        radius = self.min_radius(wheels)
        return min(self.max_yaw_rate, self.max_speed / radius) if radius > 0 else self.max_yaw_rate

    def pivot(self, wheels: Wheels) -> float:
        """Returns x of the line across the robot on which the centers of its turns lie, m."""
        return 0.0

    def check(self, wheels: Wheels) -> None:  # noqa: B027 - a drive without conditions has nothing to check
        """Checks that the drive can move these wheels.

        Raises:
            ValueError: if it cannot.
        """

    def equations(self, wheels: Wheels, dt: float, device: torch.device | str | None = None) -> Equations | None:
        """Returns the equations of the drive for these wheels and steps of ``dt`` (s).

        A batch of different robots whose drives have some is computed at once, and one by one without: ``None``.
        """
        return None

    @abstractmethod
    def advance(self, set_point: Tensor, command: Tensor, wheels: Wheels, dt: float) -> Tensor:
        """Returns the set point after ``dt``, within the limits of the drive.

        Args:
            set_point: current set point, ``[N, set_point_size]``. It is zero at rest.
            command: command, ``[N, 2]``, or ``[N, 3]`` for a drive that moves sideways.
            wheels: geometry of the wheels.
            dt: duration of a control step, s.
        """

    @abstractmethod
    def targets(self, before: Tensor, after: Tensor, wheels: Wheels) -> Joints:
        """Returns the targets of the joints in a control step.

        Args:
            before: set point at the start of the step, ``[N, set_point_size]``.
            after: set point at its end.
            wheels: geometry of the wheels.
        """

    @abstractmethod
    def odometry(self, joints: Joints, wheels: Wheels) -> Tensor:
        """Returns the twist that the joints report, ``[N, 2]``, or ``[N, 3]`` for a drive that moves sideways.

        The body moves differently where wheels slip.
        """
