"""Domain randomization: dynamics and command delays that differ between rovers and between episodes.

Simulators differ from each other and from a real robot. A policy that is trained on many variations is less sensitive
to these differences (J. Tobin et al., "Domain randomization for transferring deep neural networks from simulation to
the real world", IROS 2017; X. B. Peng et al., "Sim-to-real transfer of robotic control with dynamics randomization",
ICRA 2018). All random numbers are functions of the row's seed, its episode and the step. Sensors
add their noise themselves: see :mod:`rover_rl.envs.sensors`.
"""

from __future__ import annotations

from dataclasses import fields

import torch
from torch import Tensor

from rover_rl.envs.config import Randomization
from rover_rl.envs.rng import random_bits, to_index, to_unit
from rover_rl.sims.base import Dynamics

_DYNAMICS, _LATENCY = 2, 3
"""Streams of random numbers. :mod:`~rover_rl.envs.placement` uses 0 and 1, and sensors and
the sensed pose use 4 to 10."""


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


class CommandDelay:
    """Delays each row's commands by a number of control steps.

    Args:
        latency: range of the delay, control steps.
        num_envs: number of rows.
        size: number of components of a command.
        device: device of the commands.

    Attributes:
        steps: current delay of each row, control steps, int64 ``[N, 1]``.
    """

    def __init__(self, latency: tuple[int, int], num_envs: int, size: int, device: torch.device) -> None:
        self._min, self._max = latency
        self.steps = torch.zeros(num_envs, 1, dtype=torch.int64, device=device)
        # Queue of commands, newest first.
        self._pending = torch.zeros(num_envs, self._max + 1, size, device=device)

    def reset(self, mask: Tensor, keys: Tensor) -> None:
        """Draws a new delay for the rows of ``mask`` (bool ``[N, 1]``) and discards their pending commands."""
        if not self._max:
            return
        span = torch.full_like(self.steps, self._max - self._min + 1)
        drawn = self._min + to_index(random_bits(keys, _LATENCY, 0, 1), span)
        self.steps = torch.where(mask, drawn, self.steps)
        self._pending = self._pending.masked_fill(mask[..., None], 0.0)

    def __call__(self, command: Tensor, active: Tensor | None) -> Tensor:
        """Queues a command and returns the delayed command, ``[N, size]``.

        Args:
            command: forward speed (m/s), yaw rate (rad/s) and further components, ``[N, size]``.
            active: rows to advance, bool ``[N, 1]``. No time passes for the others. ``None`` means all rows.
        """
        if not self._max:
            return command
        pending = torch.cat((command[:, None], self._pending[:, :-1]), 1)
        self._pending = pending if active is None else torch.where(active[..., None], pending, self._pending)
        return pending.gather(1, self.steps[..., None].expand(-1, 1, pending.shape[-1])).squeeze(1)
