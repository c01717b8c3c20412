"""The differential drive: from a twist command to wheel speeds, and back to wheel odometry. Batched torch.

:class:`DifferentialDrive` is its kinematics, :class:`SimulatedDrive` what simulated rovers keep between two steps.
"""

from __future__ import annotations

import torch
from torch import Tensor

from rover_rl.sims.base import RoverState
from rover_rl.sims.robots import Robot


class DifferentialDrive:
    """Kinematics and acceleration limits of a robot's drive; holds no state.

    Args:
        robot: gives wheel radius, wheel separation and limits.
        dt: time between two commands, s.
        device: where commands are.
    """

    def __init__(self, robot: Robot, dt: float, device: torch.device | str | None = None) -> None:
        self._limit = dt * torch.tensor((robot.max_linear_acceleration, robot.max_angular_acceleration), device=device)
        half = robot.wheel_separation / 2
        self._left_right = torch.tensor((-half, half), device=device) / robot.wheel_radius
        self._inverse_radius = torch.tensor(1 / robot.wheel_radius, device=device)
        linear, angular = robot.wheel_radius / 2, robot.wheel_radius / robot.wheel_separation
        self._from_left = torch.tensor((linear, -angular), device=device)
        self._from_right = torch.tensor((linear, angular), device=device)

    def ramp(self, current: Tensor, command: Tensor) -> Tensor:
        """The twist (m/s, rad/s; ``[N, 2]``) ``dt`` after ``current``, on the way to ``command`` within the limits."""
        return current + torch.clamp(command - current, -self._limit, self._limit)

    def wheel_speeds(self, twist: Tensor) -> Tensor:
        """Speeds of the left and right wheels (rad/s, ``[N, 2]``) that drive ``twist`` without slip."""
        return torch.addcmul(twist[:, :1] * self._inverse_radius, twist[:, 1:], self._left_right)

    def odometry(self, wheel_speeds: Tensor) -> Tensor:
        """What a differential drive reports from its wheels' speeds ``[N, 2]``: forward speed and yaw rate, ``[N, 2]``.

        ``v = r (wR + wL) / 2`` (m/s) and ``w = r (wR - wL) / separation`` (rad/s): the wheels' motion, not the body's,
        which differs when they slip.
        """
        return torch.addcmul(wheel_speeds[:, :1] * self._from_left, wheel_speeds[:, 1:], self._from_right)


class SimulatedDrive:
    """The drives and clocks of a batch of simulated rovers.

    Args:
        robot: gives the drive.
        dt: duration of a control step, s.
        num_envs: rovers.
        device: where commands are.
    """

    def __init__(self, robot: Robot, dt: float, num_envs: int, device: torch.device | str | None = None) -> None:
        self._drive = DifferentialDrive(robot, dt, device)
        self._step = dt
        self._dt = torch.full((num_envs, 1), dt, device=device)
        self._twist = torch.zeros(num_envs, 2, device=device)
        self._stamp = torch.zeros(num_envs, 1, dtype=torch.float64, device=device)

    def reset(self, mask: Tensor) -> None:
        """Brings the rovers of ``mask`` (bool ``[N]``) to rest; their clocks go on."""
        self._twist = torch.where(mask[:, None], torch.zeros_like(self._twist), self._twist)

    def advance(self, commands: Tensor, active: Tensor | None) -> Tensor:
        """Speeds that the left and right wheels are to hold in the next control step, ``[N, 2]``, rad/s.

        Args:
            commands: ``[N, 2]``: forward speed (m/s) and yaw rate (rad/s).
            active: bool ``[N]``; for the other rows no time passes. ``None``: all are.
        """
        twist = self._drive.ramp(self._twist, commands)
        # The motors hold the mean of the ramp, so that the way driven is that of the limited acceleration.
        speeds = self._drive.wheel_speeds((self._twist + twist) * 0.5)
        stamp = self._stamp + self._step
        if active is not None:
            twist = torch.where(active[:, None], twist, self._twist)
            stamp = torch.where(active[:, None], stamp, self._stamp)
        self._twist, self._stamp = twist, stamp
        return speeds

    def state(self, body: Tensor, ranges: Tensor) -> RoverState:
        """The rovers' state, made of these tensors.

        Args:
            body: position (m), orientation (x, y, z, w), and mean speed of the left and the right wheels (rad/s),
                ``[N, 9]``.
            ranges: scans, ``[N, beams]``, m.
        """
        twist = self._drive.odometry(body[:, 7:])
        return RoverState.pack(
            position=body[:, :3],
            orientation=body[:, 3:7],
            linear_velocity=twist[:, :1],
            angular_velocity=twist[:, 1:],
            ranges=ranges,
            dt=self._dt,
            stamp=self._stamp,
        )
