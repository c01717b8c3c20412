"""Point-navigation task: target, events and ``outcome`` of a step, as functions of batched tensors.

Tensors have the shape ``[N, 1]`` or ``[N, k]`` and may be on any device. The ``outcome`` of a step is computed once,
from unclipped state, and rewards, metrics and ``info`` dictionaries from it. Its entries are a bool for each event in
:data:`EVENTS`; ``phase``, the :class:`StepEvent` that decides the step; ``progress``, the decrease of the distance to
the goal in this step, m; ``alignment``, see :func:`heading_alignment`; ``linear_velocity`` (m/s) and
``angular_velocity`` (rad/s) from wheel odometry; ``steps`` of the episode, and ``total_steps`` of the row; and
``world``, the index of the row's world in ``RoverEnv.pool``, if the pool has several worlds.
"""

from __future__ import annotations

import math
from dataclasses import replace
from enum import IntEnum

import torch
from tensordict import TensorDict
from torch import Tensor

from rover_rl.envs.chosen_rows import ChosenRows
from rover_rl.envs.config import EnvConfig, TaskConfig
from rover_rl.envs.placement import Placement
from rover_rl.envs.stages import Perception, StepState
from rover_rl.robots.fleet import Fleet
from rover_rl.robots.footprint import collision_ranges
from rover_rl.rotations import angle_of, wrap_angle
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
_GOAL_REACHED = slice(StepEvent.GOAL, StepEvent.GOAL + 1)


class PositionHistory:
    """Ring buffer of the last ``window`` positions of every row."""

    def __init__(self, num_envs: int, window: int, device: torch.device) -> None:
        self._window = window
        # x + iy: a position is one element.
        self._positions = torch.zeros(num_envs, window, dtype=torch.complex64, device=device)

    def displacement(self, position: Tensor, steps: Tensor) -> Tensor:
        """Stores positions ``[N, 2]``, and returns their distance from the oldest ones, ``[N, 1]``.

        It is inf until the buffer is full. ``steps`` are those of the episode, including this one, int64 ``[N, 1]``. A
        row that takes no step stores its position again.
        """
        slot, point = (steps - 1) % self._window, torch.view_as_complex(position.contiguous())[:, None]
        oldest = self._positions.scatter_(1, slot, point).gather(1, (slot + 1) % self._window)
        displacement = torch.linalg.vector_norm(torch.view_as_real(point - oldest), dim=-1)
        return displacement.masked_fill(steps < self._window, math.inf)


def target_info(position: Tensor, yaw: Tensor, goal: Tensor) -> Tensor:
    """Returns distance (m) and angle relative to the heading (rad, in (-pi, pi]) of goals, ``[N, 2]``.

    ``position`` and ``goal`` are ``[N, 2]`` (m), and ``yaw`` is ``[N, 1]`` (rad).
    """
    offset = goal - position
    distance = torch.linalg.vector_norm(offset, dim=-1, keepdim=True)
    return torch.cat((distance, wrap_angle(angle_of(offset)[..., None] - yaw)), -1)


def heading_alignment(angle: Tensor) -> Tensor:
    """Returns ``1 - 2|angle|/pi`` of the goal's angle (rad): 1 if it is ahead, 0 at a right angle, -1 behind."""
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

    ``position`` is ``[N, 2]`` (m), ``tilt`` are roll and pitch, ``[N, 2]`` (rad), ``distance`` is that to the goal (m),
    ``displacement`` that over the stuck window (m), ``collision_steps`` the number of consecutive steps in collision,
    including this one, and ``invalid`` are rows whose action was not finite, ``[N, 1]`` each. ``bounds`` are the lower
    and upper corners of each row's world, ``[N, 2]`` each (m).

    Returns the events, bool ``[N, 7]`` as in :data:`EVENTS` (a goal counts only if no event ended the episode), and the
    deciding :class:`StepEvent`, int64 ``[N, 1]``.
    """
    low, high = bounds
    flipped = (tilt.abs() > config.flip_threshold).any(-1, keepdim=True)
    outside = ((position < low) | (position > high)).any(-1, keepdim=True)
    jammed, stuck = collision_steps > config.collision_window, displacement < config.stuck_threshold
    endings = torch.cat((invalid, flipped, jammed, outside, stuck), -1)
    goal = (distance < config.success_distance) & ~endings.any(-1, keepdim=True)
    events = torch.cat((endings, goal, collision_steps > 0), -1)
    phase = torch.nn.functional.pad(events, (0, 1), value=True).to(torch.uint8).argmax(-1, keepdim=True)
    return events, phase


def with_threshold(config: EnvConfig, fleet: Fleet) -> EnvConfig:
    """Returns a description with the collision threshold of the robots, if they have the same one, in place of none."""
    thresholds = {robot.collision_range for robot in fleet.robots}
    if config.task.collision_threshold is not None or len(thresholds) > 1 or None in thresholds:
        return config
    return replace(config, task=replace(config.task, collision_threshold=thresholds.pop()))


class Navigation:
    """Sets goals from a ``placement``, and computes the outcome of each step from ``StepState.reference``.

    ``length`` is the number of steps after which an episode is truncated.
    """

    def __init__(self, config: EnvConfig, placement: Placement, fleet: Fleet) -> None:
        self._task, self.length, self._end_on_goal = config.task, config.length, config.end_on_goal
        self._placement, self._fleet = placement, fleet
        # Reading below which a rover is in collision, of all beams or of each robot and beam. Of all, pooled ones do.
        self._threshold, self._ranges = config.task.collision_threshold, torch.empty(0)
        if self._threshold is None:
            self._ranges = fleet.table(lambda robot: collision_ranges(robot, config.lidar.beams).tolist())
        self._history = PositionHistory(len(fleet), config.task.stuck_window, fleet.index.device)

    def begin(self, state: StepState, rows: ChosenRows, goal: Tensor | None) -> None:
        """Begins episodes in ``rows``: sets ``goal`` ``[N, 2]`` (m), or draws it, and clears counters."""
        mask, reference = rows.mask, state.reference
        if goal is None:
            state.goal = self._placement.draw_goal(state.keys, 0, reference.position, rows, state.goal)
        else:
            state.goal = torch.where(mask, goal, state.goal)
        target = target_info(rows.of(reference.position), rows.of(reference.yaw), rows.of(state.goal))
        state.target = rows.into(state.target, target)
        state.alignment = rows.into(state.alignment, heading_alignment(target[:, 1:]))
        state.events = state.events.masked_fill(mask, False)
        state.phase = state.phase.masked_fill(mask, StepEvent.NONE)
        state.progress = state.progress.masked_fill(mask, 0.0)
        state.goals = state.goals.masked_fill(mask, 1)
        state.collision_steps = state.collision_steps.masked_fill(mask, 0)
        state.terminated, state.truncated = state.terminated & ~mask, state.truncated & ~mask

    def advance(self, state: StepState, invalid: Tensor) -> None:
        """Computes the outcome of a step in the state's ``active`` rows, sets new goals, and ends episodes.

        ``invalid`` are rows whose action was not finite, bool ``[N, 1]``.
        """
        reference = state.reference
        target = target_info(reference.position, reference.yaw, state.goal)
        collision_steps = (state.collision_steps + 1) * self._in_collision(reference)
        events, phase = compute_terminations(
            position=reference.position,
            tilt=reference.euler[:, :2],
            distance=target[:, :1],
            displacement=self._history.displacement(reference.position, state.steps),
            collision_steps=collision_steps,
            invalid=invalid,
            bounds=(self._placement.bounds_low, self._placement.bounds_high),
            config=self._task,
        )
        progress = state.target[:, :1] - target[:, :1]
        state.take(target=target, events=events, collision_steps=collision_steps)
        state.take(progress=progress, alignment=heading_alignment(target[:, 1:]))
        state.phase = phase if state.active is None else phase.masked_fill(~state.active, StepEvent.NONE)
        if not self._end_on_goal:
            self._set_next_goals(state, state.phase == StepEvent.GOAL)
        self._end(state)

    def _in_collision(self, reference: Perception) -> Tensor:
        if self._task.collision_from == "contact":
            # RoverEnv refuses simulators without contacts for this task.
            assert reference.rover.contact is not None
            return reference.rover.contact
        if self._threshold is None:
            ranges = self._ranges[self._fleet.index] if len(self._ranges) > 1 else self._ranges
            return (reference.ranges < ranges).any(-1, keepdim=True)
        return reference.readings.amin(-1, keepdim=True) < self._threshold

    def _set_next_goals(self, state: StepState, reached: Tensor) -> None:
        # On the CPU this check is cheap and usually saves the work below. On an accelerator it would synchronize.
        if reached.device.type == "cpu" and not reached.any():
            return
        rows, reference = ChosenRows(reached), state.reference
        state.goal = self._placement.draw_goal(state.keys, state.goals, reference.position, rows, state.goal)
        target = target_info(rows.of(reference.position), rows.of(reference.yaw), rows.of(state.goal))
        state.target, state.goals = rows.into(state.target, target), state.goals + reached

    def _end(self, state: StepState) -> None:
        terminated = state.phase < StepEvent.GOAL
        if self._end_on_goal:
            terminated = terminated | state.events[:, _GOAL_REACHED]
        steps = state.steps if state.world_steps is None else state.world_steps
        state.take(terminated=terminated, truncated=(steps >= self.length) & ~terminated)


def outcome(state: StepState) -> TensorDict:
    """Returns the entries of ``outcome``, as the state has them after a step or reset."""
    entries = dict(zip(EVENTS, state.events.split(1, -1), strict=True))
    entries |= {"phase": state.phase, "progress": state.progress, "alignment": state.alignment}
    rover = state.reference.rover
    entries |= {"linear_velocity": rover.linear_velocity, "angular_velocity": rover.angular_velocity}
    entries |= {"steps": state.steps, "total_steps": state.total_steps}
    if state.world is not None:
        entries["world"] = state.world
    return unchecked_tensordict({**entries, **state.movers}, state.steps.shape[:1])
