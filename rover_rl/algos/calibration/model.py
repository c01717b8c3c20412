"""Model of a base that follows commands, for a batch of candidate parameters and windows of a drive at once.

A channel (speed or yaw rate) receives its command late by the delay, clips it to the top, changes it within the limits
of acceleration and deceleration, and follows with a lag of first order. Odometry tells the result times a gain. Of a
base whose limits act on the motor and not on the command, the lag comes first (``lag_first``).
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

STEP = 0.005  # duration of a step of the model, s
WARMUP = 1.0  # time that is simulated before a window begins, in which the model forgets its start, s
HORIZON = 3.0  # duration of a window, s

LIMITS = ("acceleration", "deceleration", "top")
NAMES = ("command_delay", *(f"{one}_{name}" for one in ("speed", "turn") for name in ("gain", "lag", *LIMITS)))
"""Names of the parameters, in their order."""
FREE = 1e3
"""Value of a limit that limits nothing."""


class Windows(NamedTuple):
    """Windows of a drive: the commands until then, and odometry in each, padded with weight 0.

    ``time`` ``[K]`` and ``area`` ``[K, 2]`` are the integral of the commands; ``start`` ``[W]``; ``first`` ``[W, 2]``
    is odometry at the start of the warmup; ``at`` ``[W, S]``, ``measured`` ``[W, S, 2]`` and ``weight`` ``[W, S]``.
    """

    time: Tensor
    area: Tensor
    start: Tensor
    first: Tensor
    at: Tensor
    measured: Tensor
    weight: Tensor


def simulate(parameters: Tensor, windows: Windows, lag_first: bool) -> Tensor:
    """Returns what odometry tells from the start of the warmup on, ``[C, W, N, 2]``, at steps of ``STEP``.

    ``parameters`` ``[C, 11]`` are those of :data:`NAMES`.
    """
    count = round((WARMUP + HORIZON) / STEP)
    grid = windows.start[:, None] - WARMUP + STEP * torch.arange(count + 1)
    delay, each = parameters[:, 0], parameters[:, 1:].unflatten(-1, (2, 5))
    gain, lag, up, down, top = (each[:, None, :, index] for index in range(5))
    # The mean of the command in a step is smooth in the delay, as its value at a time is not. Few delays differ.
    delays, which = delay.unique(return_inverse=True)
    area = _interpolate(windows.time, windows.area, grid - delays[:, None, None])
    asked = (area.diff(dim=2) / STEP).permute(2, 0, 1, 3).contiguous()
    up, down, share = up * STEP, down * STEP, 1 - torch.exp(-STEP / lag.clamp(min=1e-4))
    now = ramp = (windows.first / gain).clamp(-top, top)
    steps = []
    for commands in asked:
        goal = commands[which].clamp(-top, top)
        change = goal - ramp if not lag_first else share * (goal - now)
        most = torch.where(change * ramp >= 0, up, down)
        before, ramp = ramp, ramp + change.clamp(-most, most)
        now = ramp if lag_first else now + share * ((before + ramp) / 2 - now)
        steps.append(now * gain)
    return torch.stack(steps, 2)


def predict(parameters: Tensor, windows: Windows, lag_first: bool) -> Tensor:
    """Returns what odometry tells at the times of its readings, ``[C, W, S, 2]``."""
    steps = simulate(parameters, windows, lag_first)
    # The first entry is the state at the end of the first step.
    place = ((windows.at - windows.start[:, None] + WARMUP) / STEP - 1).clamp(0, steps.shape[2] - 1.001)
    low = place.long()
    share = (place - low)[..., None]
    rows = torch.arange(len(low))[:, None]
    return steps[:, rows, low] * (1 - share) + steps[:, rows, low + 1] * share


def _interpolate(time: Tensor, table: Tensor, at: Tensor) -> Tensor:
    """Interpolates a table ``[K, n]`` linearly at times of any shape; constant before the first."""
    index = torch.searchsorted(time, at.contiguous()).clamp(1, len(time) - 1)
    low, high = time[index - 1], time[index]
    share = ((at - low) / (high - low)).clamp(0, 1)[..., None]
    return table[index - 1] * (1 - share) + table[index] * share
