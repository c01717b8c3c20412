"""Point-navigation task: target, events and ``outcome`` of a step, as functions of batched tensors.

Tensors have the shape ``[N, 1]`` or ``[N, k]`` and may be on any device. The ``outcome`` of a step is computed once,
from unclipped state. Rewards, metrics and ``info`` dictionaries are computed from it. Its entries are:

- a bool for each event in :data:`EVENTS`;
- ``phase``: the :class:`StepEvent` that decides the step;
- ``progress``: decrease of the distance to the goal in this step, m;
- ``alignment``: heading alignment, see :func:`heading_alignment`;
- ``linear_velocity`` (m/s) and ``angular_velocity`` (rad/s) from wheel odometry;
- ``steps`` of the episode, and ``total_steps`` of the row;
- ``world``: index of the row's world in ``RoverEnv.pool``, if the pool has several worlds.
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
    """Event that decides the reward of a step, in the contract's order of priority.

    If several events happen in a step, the first in this order decides. Those before ``GOAL`` end the episode.
    """

    INVALID_ACTION = 0
    FLIP = 1
    JAM = 2
    OUT_OF_BOUNDS = 3
    STUCK = 4
    GOAL = 5
    COLLISION = 6
    DENSE = 7
    """None of the above happened: the dense reward applies."""
    NONE = 8
    """No step was taken: after a reset, and in rows that were not active."""


EVENTS = ("invalid_action", "flipped", "jammed", "out_of_bounds", "stuck", "goal_reached", "collision")
"""Names of the events in ``outcome``, in the order of :class:`StepEvent`."""


@dataclass
class TaskState:
    """State of the task of every row between steps.

    Attributes:
        goal: position of the goal, ``[N, 2]``, m.
        target: distance (m) and relative angle (rad) to the goal, ``[N, 2]``, unclipped.
        goals: number of goals set in the episode, int64 ``[N, 1]``.
        collision_steps: number of consecutive steps in collision, int64 ``[N, 1]``.
        steps: number of steps in the episode, int64 ``[N, 1]``.
        total_steps: number of steps of the row since the environment was built, int64 ``[N, 1]``.
    """

    goal: Tensor
    target: Tensor
    goals: Tensor
    collision_steps: Tensor
    steps: Tensor
    total_steps: Tensor

    @classmethod
    def zeros(cls, num_envs: int, device: torch.device) -> TaskState:
        """Creates the state before the first episode."""
        count = torch.zeros(num_envs, 1, dtype=torch.int64, device=device)
        pair = torch.zeros(num_envs, 2, device=device)
        return cls(goal=pair, target=pair, goals=count, collision_steps=count, steps=count, total_steps=count)

    def merge(self, mask: Tensor, other: TaskState) -> TaskState:
        """Returns this state in the rows of ``mask`` (bool ``[N, 1]``), and ``other`` in the other rows."""
        return TaskState(**{name: torch.where(mask, value, getattr(other, name)) for name, value in vars(self).items()})


class PositionHistory:
    """Ring buffer of the last ``window`` positions of every row.

    Args:
        num_envs: number of rows.
        window: number of positions per row.
        device: device of the positions.
    """

    def __init__(self, num_envs: int, window: int, device: torch.device) -> None:
        self._window = window
        self._rows = torch.arange(num_envs, device=device)
        self._positions = torch.zeros(num_envs, window, 2, device=device)

    def displacement(self, position: Tensor, steps: Tensor, active: Tensor | None = None) -> Tensor:
        """Stores a position and returns its distance from the oldest one, ``[N, 1]``, m; inf until the buffer is full.

        Args:
            position: current position, ``[N, 2]``, m.
            steps: number of steps in the episode, including this one, int64 ``[N, 1]``.
            active: rows that store their position, bool ``[N, 1]``. ``None`` means all rows.
        """
        slot = ((steps - 1) % self._window).squeeze(-1)
        if active is not None:
            position = torch.where(active, position, self._positions[self._rows, slot])
        self._positions[self._rows, slot] = position
        oldest = self._positions[self._rows, (slot + 1) % self._window]
        displacement = torch.linalg.vector_norm(position - oldest, dim=-1, keepdim=True)
        return displacement.masked_fill(steps < self._window, math.inf)


def target_info(position: Tensor, yaw: Tensor, goal: Tensor) -> Tensor:
    """Returns distance (m) and angle relative to the heading (rad, in (-pi, pi]) of the goal, ``[N, 2]``.

    Args:
        position: position of the rover, ``[N, 2]``, m.
        yaw: heading of the rover, ``[N, 1]``, rad.
        goal: position of the goal, ``[N, 2]``, m.
    """
    offset = goal - position
    distance = torch.linalg.vector_norm(offset, dim=-1, keepdim=True)
    return torch.cat((distance, wrap_angle(angle_of(offset)[..., None] - yaw)), -1)


def heading_alignment(angle: Tensor) -> Tensor:
    """Returns the heading alignment ``1 - 2|angle|/pi``: 1 if the goal is ahead, 0 at a right angle, -1 behind.

    Args:
        angle: angle of the goal relative to the heading, rad.
    """
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
    """Computes the events of a step, and the one that decides it.

    Args:
        position: position of the rover, ``[N, 2]``, m.
        tilt: roll and pitch, ``[N, 2]``, rad.
        distance: distance to the goal, ``[N, 1]``, m.
        displacement: displacement over the stuck window, ``[N, 1]``, m.
        collision_steps: number of consecutive steps in collision, including this one, ``[N, 1]``.
        invalid: rows whose action was not finite, bool ``[N, 1]``.
        bounds: lower and upper corners of the bounds of each row's world, ``[N, 2]`` each, m.
        config: thresholds.

    Returns:
        Events, bool ``[N, 7]`` in the order of :data:`EVENTS` (a goal counts only if no event ended the episode), and
        the deciding :class:`StepEvent`, int64 ``[N, 1]``.
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
    """Creates the nested ``outcome``.

    Args:
        events: events in the order of :data:`EVENTS`, bool ``[N, 7]``.
        **fields: further entries, ``[N, 1]`` each.
    """
    named = dict(zip(EVENTS, events.split(1, -1), strict=True))
    return unchecked_tensordict({**named, **fields}, events.shape[:1])
