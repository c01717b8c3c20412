"""Point navigation: target, events and phase, as pure functions of the batch.

Everything here is ``[N, 1]`` or ``[N, k]``, on any device. What happened in a step is computed once, from unclipped
state, and handed on as ``outcome``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import IntEnum

import torch
from tensordict import TensorDict
from torch import Tensor

from rover_rl.envs.config import TaskConfig
from rover_rl.sims.rotations import angle_of, wrap_angle
from rover_rl.tensordicts import unchecked_tensordict


class StepEvent(IntEnum):
    """Which rule decides a step: the first of these that holds, in the contract's order.

    The members before ``GOAL`` end the episode.
    """

    INVALID_ACTION = 0
    FLIP = 1
    JAM = 2
    OUT_OF_BOUNDS = 3
    STUCK = 4
    GOAL = 5
    COLLISION = 6
    DENSE = 7
    NONE = 8
    """No step was taken: after a reset, and on rows that were held."""


EVENTS = ("invalid_action", "flipped", "jammed", "out_of_bounds", "stuck", "goal_reached", "collision")
"""Names of the events in ``outcome``, in the order of :class:`StepEvent`."""


@dataclass
class TaskState:
    """What the task remembers of every row between steps.

    Attributes:
        goal: ``[N, 2]``, m.
        target: distance (m) and relative angle (rad) to the goal, ``[N, 2]``, unclipped.
        goals: goals that the episode has had, int64 ``[N, 1]``.
        collision_steps: steps in a row in collision, int64 ``[N, 1]``.
        steps: of the episode, int64 ``[N, 1]``.
        total_steps: of the row since it was made, int64 ``[N, 1]``.
    """

    goal: Tensor
    target: Tensor
    goals: Tensor
    collision_steps: Tensor
    steps: Tensor
    total_steps: Tensor

    @classmethod
    def zeros(cls, num_envs: int, device: torch.device) -> TaskState:
        """The state before the first episode."""
        count = torch.zeros(num_envs, 1, dtype=torch.int64, device=device)
        pair = torch.zeros(num_envs, 2, device=device)
        return cls(goal=pair, target=pair, goals=count, collision_steps=count, steps=count, total_steps=count)

    def merge(self, mask: Tensor, other: TaskState) -> TaskState:
        """This state on the rows of ``mask`` (bool ``[N, 1]``), ``other`` on the rest."""
        return TaskState(**{name: torch.where(mask, value, getattr(other, name)) for name, value in vars(self).items()})


class PositionHistory:
    """The last ``window`` positions of every row, in place.

    Args:
        num_envs: rows.
        window: positions remembered.
        device: where the rows live.
    """

    def __init__(self, num_envs: int, window: int, device: torch.device) -> None:
        self._window = window
        self._rows = torch.arange(num_envs, device=device)
        self._positions = torch.zeros(num_envs, window, 2, device=device)

    def displacement(self, position: Tensor, steps: Tensor, active: Tensor | None = None) -> Tensor:
        """Remembers this step's position and returns the way from the oldest one, ``[N, 1]``, m; inf until full.

        Args:
            position: ``[N, 2]``, m.
            steps: steps of the episode, this one included, int64 ``[N, 1]``.
            active: bool ``[N, 1]``; the other rows remember nothing.
        """
        slot = ((steps - 1) % self._window).squeeze(-1)
        if active is not None:
            position = torch.where(active, position, self._positions[self._rows, slot])
        self._positions[self._rows, slot] = position
        oldest = self._positions[self._rows, (slot + 1) % self._window]
        way = torch.linalg.vector_norm(position - oldest, dim=-1, keepdim=True)
        return way.masked_fill(steps < self._window, math.inf)


def target_info(position: Tensor, yaw: Tensor, goal: Tensor) -> Tensor:
    """Distance (m) and angle relative to the heading (rad, in (-pi, pi]) of a goal: ``[N, 2]``.

    Args:
        position, goal: ``[N, 2]``, m.
        yaw: ``[N, 1]``, rad.
    """
    away = goal - position
    distance = torch.linalg.vector_norm(away, dim=-1, keepdim=True)
    return torch.cat((distance, wrap_angle(angle_of(away)[..., None] - yaw)), -1)


def heading_alignment(angle: Tensor) -> Tensor:
    """How well the rover faces its goal: 1 ahead, 0 at a right angle, -1 behind (the contract's ``1 - 2|a|/pi``)."""
    return 1 - angle.abs() * (2 / math.pi)


def compute_terminations(
    *,
    position: Tensor,
    tilt: Tensor,
    distance: Tensor,
    displacement: Tensor,
    collision_steps: Tensor,
    invalid: Tensor,
    bounds: tuple[Tensor, Tensor],
    config: TaskConfig,
) -> tuple[Tensor, Tensor]:
    """Which events happened in a step, and which rule decides it.

    Args:
        position: ``[N, 2]``, m.
        tilt: roll and pitch, ``[N, 2]``, rad.
        distance: to the goal, ``[N, 1]``, m.
        displacement: over the stuck window, ``[N, 1]``, m.
        collision_steps: steps in a row in collision, this one included, ``[N, 1]``.
        invalid: rows whose action was not finite, bool ``[N, 1]``.
        bounds: corners of the rows' bounds, ``[N, 2]`` each, m.
        config: thresholds.

    Returns:
        Events, bool ``[N, 7]`` in the order of :data:`EVENTS` (a goal counts only where nothing ended the episode), and
        the :class:`StepEvent`, int64 ``[N, 1]``.
    """
    low, high = bounds
    endings = torch.cat(
        (
            invalid,
            (tilt.abs() > config.flip_threshold).any(-1, keepdim=True),
            collision_steps > config.collision_window,
            ((position < low) | (position > high)).any(-1, keepdim=True),
            displacement < config.stuck_threshold,
        ),
        -1,
    )
    goal = (distance < config.success_distance) & ~endings.any(-1, keepdim=True)
    events = torch.cat((endings, goal, collision_steps > 0), -1)
    phase = torch.nn.functional.pad(events, (0, 1), value=True).to(torch.uint8).argmax(-1, keepdim=True)
    return events, phase


def pack_outcome(events: Tensor, **fields: Tensor) -> TensorDict:
    """The nested ``outcome``: one bool ``[N, 1]`` an event, and ``fields`` as they are."""
    named = dict(zip(EVENTS, events.split(1, -1), strict=True))
    return unchecked_tensordict({**named, **fields}, events.shape[:1])
