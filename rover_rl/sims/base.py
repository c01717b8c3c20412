"""The seam between the task and what moves the rover."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, Protocol, TypeAlias, runtime_checkable

import torch
from tensordict import TensorClass, TensorDict
from torch import Tensor

View: TypeAlias = Literal["chase", "top"]


class RoverState(TensorClass):
    """What is known of every rover at one moment. Batch size ``[N]``; float32 unless said otherwise.

    Attributes:
        position: of the base frame in the world, ``[N, 3]``, m.
        orientation: of the base frame, unit quaternion ``[N, 4]`` as (x, y, z, w).
        linear_velocity: by wheel odometry, forward, ``[N, 1]``, m/s.
        angular_velocity: by wheel odometry, counter-clockwise, ``[N, 1]``, rad/s.
        ranges: the raw scan, ``[N, beams]``, m: beam 0 points forward, beams go counter-clockwise; ``inf`` is no
            return, 0 a beam that starts inside something.
        dt: time since the scan before, ``[N, 1]``, s.
        stamp: time of the scan, ``[N, 1]``, s, float64.
    """

    position: Tensor
    orientation: Tensor
    linear_velocity: Tensor
    angular_velocity: Tensor
    ranges: Tensor
    dt: Tensor
    stamp: Tensor

    @classmethod
    def pack(cls, **fields: Tensor) -> RoverState:
        """A state from tensors of the right shapes, unchecked: for the hot path."""
        batch_size = fields["position"].shape[:1]
        return cls._from_tensordict(TensorDict._new_unsafe(fields, batch_size=batch_size))


@dataclass(frozen=True)
class Dynamics:
    """Factors of what simulated rovers are by their description, float32 ``[N]`` each.

    Attributes:
        friction: of all friction coefficients.
        chassis_mass: of the mass and the inertia of the chassis, not of the wheels.
        motor_torque: of the most torque that the wheels' motors give.
    """

    friction: Tensor
    chassis_mass: Tensor
    motor_torque: Tensor


@runtime_checkable
class Simulator(Protocol):
    """A batch of rovers somewhere: in a simulation, or one real rover.

    A backend that lives on a GPU takes and returns GPU tensors. Tensors handed out are never written to again.

    Attributes:
        num_envs: number of rovers, the rows of every tensor.
        control_dt: duration of a control step, s.
        device: where its tensors live.
        ray_angles: direction of each lidar beam in the rover's frame, ``[beams]``, rad, from 0 counter-clockwise.
    """

    num_envs: int
    control_dt: float
    device: torch.device
    ray_angles: Tensor

    @property
    def robot_connected(self) -> bool:
        """Whether there are rovers to drive: of simulated ones always."""
        ...

    def reset(self, mask: Tensor, poses: Tensor) -> RoverState:
        """Puts the rovers of ``mask`` (bool ``[N]``) on the ground at ``poses`` (``[N, 3]``: x, y in m, yaw in rad).

        They are at rest then; the other rows stay as they are.
        """
        ...

    def set_dynamics(self, mask: Tensor, dynamics: Dynamics) -> None:
        """Gives the rovers of ``mask`` (bool ``[N]``) these dynamics; they are to be reset next.

        Raises:
            ValueError: for live rovers, which are what they are.
        """
        ...

    def state(self) -> RoverState:
        """The present state, without moving anything."""
        ...

    def step(self, commands: Tensor, active: Tensor | None = None) -> RoverState:
        """Drives one control step.

        Args:
            commands: ``[N, 2]``: forward speed (m/s) and yaw rate (rad/s, counter-clockwise).
            active: bool ``[N]``; for the rows that are not active no time passes. ``None``: all are.
        """
        ...

    def render(self, row: int, view: View, width: int, height: int, goal: Tensor | None = None) -> Tensor:
        """A picture of one rover and of its ``goal`` (``[2]``, m): uint8 ``[height, width, 3]``."""
        ...

    def close(self) -> None:
        """Lets go of everything; may be called again."""
        ...
