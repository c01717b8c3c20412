"""``RoverState``: what a simulator tells about its rovers, and ``Dynamics``: what it is told about them."""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np
import torch
from tensordict import TensorClass
from torch import Tensor

from rover_rl.tensordicts import unchecked_tensordict

Force: TypeAlias = Literal["contact_force", "wheel_torque"]
"""Fields of :class:`RoverState` that a simulator measures only if asked: see :meth:`Simulator.measure`."""
SIDES = ("front", "left", "back", "right")
"""Sides of a rover in the base frame, in the order of the columns of ``RoverState.contact_force``."""


class RoverState(TensorClass):
    """Batched rover state, with batch size ``[N]``. Tensors are float32 unless stated otherwise.

    Contact forces and motor torques are means over the physics steps of a control step, ``None`` unless asked for:
    simulators agree on these, and not on the peak of an impact.

    Attributes:
        position: position of the base frame in the world frame, ``[N, 3]``, m.
        orientation: orientation of the base frame, unit quaternion (x, y, z, w), ``[N, 4]``.
        linear_velocity: forward speed from wheel odometry, ``[N, 1]``, m/s.
        angular_velocity: counter-clockwise yaw rate from wheel odometry, ``[N, 1]``, rad/s.
        dt: duration of the last step, ``[N, 1]``, s.
        stamp: time of the state, ``[N, 1]``, s, float64.
        contact: whether any part of the rover, chassis or wheel, touched an obstacle in any physics step of the last
            control step, bool ``[N, 1]``. The ground is no obstacle, also where it scrapes the chassis. False after a
            reset. ``None`` if the backend does not report contacts.
        lateral_velocity: speed to the left from wheel odometry, ``[N, 1]``, m/s. ``None`` unless the drive moves
            sideways.
        mover_contact: whether the rover touched a mover in the last control step, bool ``[N, 1]``. ``contact`` is true,
            too, then. ``None`` if the simulator has no movers.
        contact_force: horizontal normal forces on the rover by the side that they come from, front, left, back and
            right in the base frame: those of obstacles, then those of movers, ``[N, 8]``, N, summed over the contacts.
            Zero after a reset.
        wheel_torque: torque that the motor of each wheel exerts on it, in the order of ``Drive.wheels``,
            ``[N, W]``, N m. Positive torques drive forward. Zero after a reset, for a wheel without a motor, and beyond
            the wheels of a robot that has fewer than others of the batch.
    """

    position: Tensor
    orientation: Tensor
    linear_velocity: Tensor
    angular_velocity: Tensor
    dt: Tensor
    stamp: Tensor
    contact: Tensor | None = None
    lateral_velocity: Tensor | None = None
    mover_contact: Tensor | None = None
    contact_force: Tensor | None = None
    wheel_torque: Tensor | None = None

    @classmethod
    def pack(cls, **fields: Tensor) -> RoverState:
        """Creates a state without checking the shapes of its tensors, which saves time in every step."""
        return cls.from_tensordict(unchecked_tensordict(fields, fields["position"].shape[:1]))


@dataclass(frozen=True)
class Dynamics:
    """Scale factors of the dynamics of simulated rovers, relative to the robot description. Float32 ``[N]`` each.

    They are those of all friction coefficients, of mass and inertia of the chassis without its wheels, and of the
    maximum torque of the wheel motors.
    """

    friction: Tensor
    chassis_mass: Tensor
    motor_torque: Tensor


def beam_angles(beams: int) -> Tensor:
    """Directions that are equally spaced over a full turn, from straight ahead, float64 ``[beams]``, rad."""
    return torch.arange(beams, dtype=torch.float64) * (2 * math.pi / beams)


def by_side(push: np.ndarray) -> np.ndarray:
    """Forces on the rover ``[..., 2]`` along x and y of the base frame (N) by :data:`SIDES`, ``[..., 4]``, N.

    What pushes backward is in front. A force at an angle counts on two sides, by its components.
    """
    return np.concatenate((-push, push), -1).clip(0.0)


def no_forces(fields: Collection[Force], count: int, wheels: int) -> dict[Force, np.ndarray]:
    """Zeros of each of the fields, float32 ``[count, k]``, for robots with so many wheels."""
    sizes: dict[Force, int] = {"contact_force": 2 * len(SIDES), "wheel_torque": wheels}
    return {field: np.zeros((count, size), np.float32) for field, size in sizes.items() if field in fields}
