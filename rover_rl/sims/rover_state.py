"""``RoverState``: what a simulator tells about its rovers, ``Dynamics``: what it is told, and ``SimulatedDrives``."""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np
import torch
from tensordict import TensorClass
from torch import Tensor
from torch.nn.functional import pad

from rover_rl.robots.drives import Joints
from rover_rl.robots.fleet import Fleet
from rover_rl.robots.kinematics import Kinematics
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


class SimulatedDrives:
    """Drives and clocks of a batch of simulated rovers, for steps of ``dt`` (s). Changes of the index are followed."""

    def __init__(self, fleet: Fleet, dt: float) -> None:
        self._kinematics, self._step = Kinematics(fleet, dt), dt
        self._first_angle = 7 + self._kinematics.motors
        count, device = len(fleet), fleet.index.device
        self._dt = torch.full((count, 1), dt, device=device)
        self._set_point = torch.zeros(count, self._kinematics.size, device=device)
        self._stamp = torch.zeros(count, 1, dtype=torch.float64, device=device)

    def reset(self, mask: Tensor) -> None:
        """Sets the drives of the rovers in ``mask`` (bool ``[N]``) to rest. Their clocks continue."""
        self._set_point = torch.where(mask[:, None], torch.zeros_like(self._set_point), self._set_point)

    def advance(self, commands: Tensor, active: Tensor | None) -> Joints:
        """Advances the drives and clocks by one control step, and returns the targets of the joints for this step.

        The arguments are those of :meth:`Simulator.step`.
        """
        if self._kinematics.sideways and commands.shape[-1] == 2:
            commands = pad(commands, (0, 1))
        set_point = self._kinematics.advance(self._set_point, commands)
        targets = self._kinematics.joints(self._set_point, set_point)
        stamp = self._stamp + self._step
        if active is not None:
            set_point = torch.where(active[:, None], set_point, self._set_point)
            stamp = torch.where(active[:, None], stamp, self._stamp)
        self._set_point, self._stamp = set_point, stamp
        return targets

    def odometry(self, joints: Joints) -> Tensor:
        return self._kinematics.odometry(joints)

    def state(
        self, body: Tensor, contact: Tensor | None = None, mover_contact: Tensor | None = None, **reports: Tensor
    ) -> RoverState:
        """Returns the state of the rovers, with what else the simulator knows.

        ``body`` is position (m), orientation (x, y, z, w), speed of each motor (rad/s) and angle of each steering joint
        (rad), ``[N, 7 + M + S]``.
        """
        twist = self.odometry(Joints(body[:, 7 : self._first_angle], body[:, self._first_angle :]))
        optional = {"contact": contact, "mover_contact": mover_contact}
        if self._kinematics.sideways:
            optional["lateral_velocity"] = twist[:, 2:]
        return RoverState.pack(
            position=body[:, :3],
            orientation=body[:, 3:7],
            linear_velocity=twist[:, :1],
            angular_velocity=twist[:, 1:2],
            dt=self._dt,
            stamp=self._stamp,
            **{name: value for name, value in optional.items() if value is not None},
            **reports,
        )
