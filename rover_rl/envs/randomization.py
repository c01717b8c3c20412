"""Domain randomization: rovers, sensors and delays that differ between rovers and between episodes.

Simulators differ from one another and from a real robot. A policy trained on many variations is less sensitive to the
difference (J. Tobin et al., "Domain randomization for transferring deep neural networks from simulation to the real
world", IROS 2017; X. B. Peng et al., "Sim-to-real transfer of robotic control with dynamics randomization", ICRA 2018).
Every draw is a function of the row's seed, its episode and the step.
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
"""Streams of random draws, beside those of placement."""


def draw_dynamics(randomization: Randomization, keys: Tensor) -> Dynamics:
    """Factors of each row's rover, float32 ``[N]`` each, from episode keys ``[N, 1]``."""
    names = [item.name for item in fields(Dynamics)]
    fractions = to_unit(random_bits(keys, _DYNAMICS, 0, len(names))).unbind(-1)
    ranges = {name: getattr(randomization, name) for name in names}
    pairs = zip(fractions, ranges.items(), strict=True)
    return Dynamics(**{name: low + fraction * (high - low) for fraction, (name, (low, high)) in pairs})


def sense(randomization: Randomization, rover: RoverState, keys: Tensor, step: Tensor) -> RoverState:
    """Adds sensor noise to a state; without noise, returns the state itself.

    Args:
        randomization: the noise.
        rover: true state, ``[N]``.
        keys: keys of the episodes, ``[N, 1]``.
        step: number of the step in its episode, ``[N, 1]``.
    """
    noise, sensed = randomization, dict[str, Tensor]()
    if noise.range_noise or noise.dropout:
        sensed["ranges"] = _scan(noise, rover.ranges, keys, step)
    if noise.odometry_noise:
        linear, angular = (1 + noise.odometry_noise * _normal(keys, _ODOMETRY, step, 2)).split(1, -1)
        sensed["linear_velocity"] = rover.linear_velocity * linear
        sensed["angular_velocity"] = rover.angular_velocity * angular
    if noise.imu_noise:
        # A small rotation about a random axis: half of its angle is the vector part of its quaternion.
        turn = 0.5 * noise.imu_noise * _normal(keys, _IMU, step, 3)
        turn = torch.cat((turn, torch.ones_like(turn[:, :1])), -1)
        sensed["orientation"] = quaternion_product(rover.orientation, turn / turn.norm(dim=-1, keepdim=True))
    return RoverState.pack(**(dict(rover.items()) | sensed)) if sensed else rover


def _scan(noise: Randomization, ranges: Tensor, keys: Tensor, step: Tensor) -> Tensor:
    bits = random_bits(keys, _RANGES, step, ranges.shape[-1])
    if noise.range_noise:
        # Noise moves no return into the lidar, and gives no return to a beam without one.
        ranges = torch.where(ranges > 0, (ranges + noise.range_noise * _to_normal(bits)).clamp_min(0.001), ranges)
    if noise.dropout:
        # The upper bits, which the noise does not use.
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
        steps: present delay of each row, int64 ``[N, 1]``.
    """

    def __init__(self, latency: tuple[int, int], num_envs: int, device: torch.device) -> None:
        self._least, self._most = latency
        self.steps = torch.zeros(num_envs, 1, dtype=torch.int64, device=device)
        # The newest command comes first.
        self._waiting = torch.zeros(num_envs, self._most + 1, 2, device=device)

    def reset(self, mask: Tensor, keys: Tensor) -> None:
        """Draws a new delay for the rows of ``mask`` (bool ``[N, 1]``), and drops their pending commands."""
        if not self._most:
            return
        span = torch.full_like(self.steps, self._most - self._least + 1)
        drawn = self._least + to_index(random_bits(keys, _LATENCY, 0, 1), span)
        self.steps = torch.where(mask, drawn, self.steps)
        self._waiting = self._waiting.masked_fill(mask[..., None], 0.0)

    def __call__(self, command: Tensor, active: Tensor | None) -> Tensor:
        """The command that arrives when ``command [N, 2]`` is sent.

        For rows that are not ``active`` (bool ``[N, 1]``) no time passes.
        """
        if not self._most:
            return command
        waiting = torch.cat((command[:, None], self._waiting[:, :-1]), 1)
        self._waiting = waiting if active is None else torch.where(active[..., None], waiting, self._waiting)
        return waiting.gather(1, self.steps[..., None].expand(-1, 1, 2)).squeeze(1)


def _normal(keys: Tensor, stream: int, draw: Tensor, count: int) -> Tensor:
    return _to_normal(random_bits(keys, stream, draw, count))


def _to_normal(bits: Tensor) -> Tensor:
    """Standard normal numbers from the lower 48 bits (Box and Muller, 1958): float32."""
    radius = torch.sqrt(-2 * torch.log(1 - to_unit(bits)))
    return radius * torch.cos(2 * math.pi * to_unit(bits >> 24))
