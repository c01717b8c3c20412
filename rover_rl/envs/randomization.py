"""Domain randomization: dynamics, sensor noise and command delays that differ between rovers and between episodes.

Simulators differ from each other and from a real robot. A policy that is trained on many variations is less sensitive
to these differences (J. Tobin et al., "Domain randomization for transferring deep neural networks from simulation to
the real world", IROS 2017; X. B. Peng et al., "Sim-to-real transfer of robotic control with dynamics randomization",
ICRA 2018). All random numbers are functions of the row's seed, its episode and the step.
"""

from __future__ import annotations

import math
from dataclasses import fields

import torch
from torch import Tensor

from rover_rl.envs.config import Randomization
from rover_rl.envs.rng import random_bits, to_index, to_unit
from rover_rl.sims import RoverState
from rover_rl.sims.base import Dynamics
from rover_rl.sims.rotations import quaternion_product

_DYNAMICS, _LATENCY, _RANGES, _ODOMETRY, _IMU = 2, 3, 4, 5, 6
"""Streams of random numbers. :mod:`~rover_rl.envs.placement` uses 0 and 1."""


def draw_dynamics(randomization: Randomization, keys: Tensor) -> Dynamics:
    """Draws the scale factors of each row's dynamics, float32 ``[N]`` each.

    Args:
        randomization: ranges of the factors.
        keys: random keys of the episodes, ``[N, 1]``.
    """
    names = [item.name for item in fields(Dynamics)]
    fractions = to_unit(random_bits(keys, _DYNAMICS, 0, len(names))).unbind(-1)
    ranges = {name: getattr(randomization, name) for name in names}
    pairs = zip(fractions, ranges.items(), strict=True)
    return Dynamics(**{name: low + fraction * (high - low) for fraction, (name, (low, high)) in pairs})


def sense(
    randomization: Randomization, rover: RoverState, keys: Tensor, step: Tensor, scan_period: int = 1
) -> RoverState:
    """Adds sensor noise to a state. Returns the same object if there is no noise.

    Args:
        randomization: parameters of the noise.
        rover: true state of the rovers, ``[N]``.
        keys: random keys of the episodes, ``[N, 1]``.
        step: index of the step in its episode, ``[N, 1]``.
        scan_period: number of steps from one scan to the next. A scan keeps its noise.
    """
    noise, sensed = randomization, dict[str, Tensor]()
    if noise.range_noise or noise.dropout:
        sensed["ranges"] = _scan(noise, rover.ranges, keys, step - step % scan_period)
    if noise.odometry_noise:
        linear, angular = (1 + noise.odometry_noise * _normal(keys, _ODOMETRY, step, 2)).split(1, -1)
        sensed["linear_velocity"] = rover.linear_velocity * linear
        sensed["angular_velocity"] = rover.angular_velocity * angular
    if noise.imu_noise:
        # A small rotation about a random axis. The vector part of its quaternion is half the rotation vector.
        turn = 0.5 * noise.imu_noise * _normal(keys, _IMU, step, 3)
        turn = torch.cat((turn, torch.ones_like(turn[:, :1])), -1)
        sensed["orientation"] = quaternion_product(rover.orientation, turn / turn.norm(dim=-1, keepdim=True))
    return RoverState.pack(**(dict(rover.items()) | sensed)) if sensed else rover


def _scan(noise: Randomization, ranges: Tensor, keys: Tensor, step: Tensor) -> Tensor:
    bits = random_bits(keys, _RANGES, step, ranges.shape[-1])
    if noise.range_noise:
        # A range stays positive, a 0 (beam that starts inside a solid) stays 0, and inf (no return) stays inf.
        ranges = torch.where(ranges > 0, (ranges + noise.range_noise * _to_normal(bits)).clamp_min(0.001), ranges)
    if noise.dropout:
        # The upper 16 bits. The noise uses the lower 48.
        lost = (bits >> 48 & 0xFFFF) < round(noise.dropout * 0x10000)
        ranges = ranges.masked_fill(lost, math.inf)
    return ranges


class CommandDelay:
    """Delays each row's commands by a number of control steps.

    Args:
        latency: range of the delay, control steps.
        num_envs: number of rows.
        device: device of the commands.

    Attributes:
        steps: current delay of each row, control steps, int64 ``[N, 1]``.
    """

    def __init__(self, latency: tuple[int, int], num_envs: int, device: torch.device) -> None:
        self._min, self._max = latency
        self.steps = torch.zeros(num_envs, 1, dtype=torch.int64, device=device)
        # Queue of commands, newest first.
        self._pending = torch.zeros(num_envs, self._max + 1, 2, device=device)

    def reset(self, mask: Tensor, keys: Tensor) -> None:
        """Draws a new delay for the rows of ``mask`` (bool ``[N, 1]``) and discards their pending commands."""
        if not self._max:
            return
        span = torch.full_like(self.steps, self._max - self._min + 1)
        drawn = self._min + to_index(random_bits(keys, _LATENCY, 0, 1), span)
        self.steps = torch.where(mask, drawn, self.steps)
        self._pending = self._pending.masked_fill(mask[..., None], 0.0)

    def __call__(self, command: Tensor, active: Tensor | None) -> Tensor:
        """Queues a command and returns the delayed command, ``[N, 2]``.

        Args:
            command: forward speed (m/s) and yaw rate (rad/s), ``[N, 2]``.
            active: rows to advance, bool ``[N, 1]``. No time passes for the others. ``None`` means all rows.
        """
        if not self._max:
            return command
        pending = torch.cat((command[:, None], self._pending[:, :-1]), 1)
        self._pending = pending if active is None else torch.where(active[..., None], pending, self._pending)
        return pending.gather(1, self.steps[..., None].expand(-1, 1, 2)).squeeze(1)


def _normal(keys: Tensor, stream: int, draw: Tensor, count: int) -> Tensor:
    return _to_normal(random_bits(keys, stream, draw, count))


def _to_normal(bits: Tensor) -> Tensor:
    """Returns standard normal numbers from the lower 48 bits, float32 (Box and Muller, 1958)."""
    radius = torch.sqrt(-2 * torch.log(1 - to_unit(bits)))
    return radius * torch.cos(2 * math.pi * to_unit(bits >> 24))
