"""Differential drive: wheel speeds from twist commands, and odometry from wheel speeds. Batched torch.

:class:`DifferentialDrive` implements the kinematics and limits, :class:`SimulatedDrive` holds the state of the drives
of simulated rovers.
"""

from __future__ import annotations

import torch
from torch import Tensor

from rover_rl.sims.base import RoverState
from rover_rl.sims.robots import Robot


class DifferentialDrive:
    """Stateless kinematics and acceleration limits of a robot's drive.

    Args:
        robot: robot that defines the wheel radius, the wheel separation and the acceleration limits.
        dt: time between two commands, s.
        device: device of the commands.
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
        """Returns the twist after ``dt``, limited in acceleration.

        Args:
            current: current twist, ``[N, 2]``: forward speed (m/s) and yaw rate (rad/s).
            command: commanded twist, ``[N, 2]``.

        Returns:
            Twist after ``dt``, ``[N, 2]``.
        """
        return current + torch.clamp(command - current, -self._limit, self._limit)

    def wheel_speeds(self, twist: Tensor) -> Tensor:
        """Returns the left and right wheel speeds (rad/s, ``[N, 2]``) that produce ``twist`` without slip."""
        return torch.addcmul(twist[:, :1] * self._inverse_radius, twist[:, 1:], self._left_right)

    def odometry(self, wheel_speeds: Tensor) -> Tensor:
        """Returns the forward speed and yaw rate ``[N, 2]`` computed from the wheel speeds ``[N, 2]``.

        ``v = r (wR + wL) / 2`` (m/s) and ``w = r (wR - wL) / separation`` (rad/s). This is the motion of the wheels,
        from which the motion of the body differs when the wheels slip.
        """
        return torch.addcmul(wheel_speeds[:, :1] * self._from_left, wheel_speeds[:, 1:], self._from_right)


class SimulatedDrive:
    """State of the drives and clocks of a batch of simulated rovers.

    Args:
        robot: robot that defines the drive.
        dt: duration of a control step, s.
        num_envs: number of rovers.
        device: device of the commands.
    """

    def __init__(self, robot: Robot, dt: float, num_envs: int, device: torch.device | str | None = None) -> None:
        self._drive = DifferentialDrive(robot, dt, device)
        self._step = dt
        self._dt = torch.full((num_envs, 1), dt, device=device)
        self._twist = torch.zeros(num_envs, 2, device=device)
        self._stamp = torch.zeros(num_envs, 1, dtype=torch.float64, device=device)

    def reset(self, mask: Tensor) -> None:
        """Sets the twist of the rovers in ``mask`` (bool ``[N]``) to zero. Their clocks continue."""
        self._twist = torch.where(mask[:, None], torch.zeros_like(self._twist), self._twist)

    def advance(self, commands: Tensor, active: Tensor | None) -> Tensor:
        """Advances the drives and clocks by one control step.

        Args:
            commands: forward speed (m/s) and yaw rate (rad/s), ``[N, 2]``.
            active: rovers to advance, bool ``[N]``. No time passes for the others. ``None`` advances all.

        Returns:
            Target speeds of the left and right wheels for this step, ``[N, 2]``, rad/s.
        """
        twist = self._drive.ramp(self._twist, commands)
        # The motors hold the mean speed of the ramp, so that the distance driven matches the limited acceleration.
        speeds = self._drive.wheel_speeds((self._twist + twist) * 0.5)
        stamp = self._stamp + self._step
        if active is not None:
            twist = torch.where(active[:, None], twist, self._twist)
            stamp = torch.where(active[:, None], stamp, self._stamp)
        self._twist, self._stamp = twist, stamp
        return speeds

    def state(self, body: Tensor, ranges: Tensor, contact: Tensor | None = None) -> RoverState:
        """Returns the state of the rovers.

        Args:
            body: position (m), orientation (x, y, z, w), and mean speeds of the left and right wheels (rad/s),
                ``[N, 9]``.
            ranges: lidar scans, ``[N, beams]``, m.
            contact: whether the rovers touched an obstacle, bool ``[N, 1]``. ``None`` if the simulator does not know.
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
            **({} if contact is None else {"contact": contact}),
        )
