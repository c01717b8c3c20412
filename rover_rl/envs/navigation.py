"""Navigation: goals, events and endings of every row."""

from __future__ import annotations

from dataclasses import replace

import torch
from tensordict import TensorDict
from torch import Tensor

from rover_rl.envs.config import EnvConfig
from rover_rl.envs.perception import StepState
from rover_rl.envs.placement import Placement
from rover_rl.envs.task import (
    EVENTS,
    PositionHistory,
    StepEvent,
    TaskState,
    compute_terminations,
    heading_alignment,
    pack_outcome,
    target_info,
)


class Navigation:
    """Sets goals, and computes the outcome of each step from ``judged``, the state that events follow.

    Args:
        config: description of the environment.
        placement: draws goals, and knows the bounds of each row's world.
        num_envs: number of rows.
        device: device of the rows.

    Attributes:
        length: number of steps after which an episode is truncated.
    """

    def __init__(self, config: EnvConfig, placement: Placement, num_envs: int, device: torch.device) -> None:
        self._task, self.length, self._end_on_goal = config.task, config.length, config.end_on_goal
        self._placement = placement
        self._history = PositionHistory(num_envs, config.task.stuck_window, device)

    def begin(self, now: StepState, mask: Tensor, goal: Tensor | None, keys: Tensor, first: bool) -> None:
        """Begins the episodes of the rows of ``mask``: goals, counters, and an outcome without events.

        Args:
            now: state of the environment, after the reset of these rows.
            mask: rows to begin, bool ``[N, 1]``.
            goal: their goals, ``[N, 2]``, m; ``None`` draws them.
            keys: keys of the episodes, ``[N, 1]``.
            first: whether no episode has begun before.
        """
        none = torch.zeros_like(keys)
        judged = now.judged
        if goal is None:
            goal = self._placement.draw_goal(keys, none, judged.position)
        fresh = TaskState(
            goal=goal,
            target=target_info(judged.position, judged.yaw, goal),
            goals=none + 1,
            collision_steps=none,
            steps=none,
            total_steps=now.task.total_steps,
        )
        now.task = fresh.merge(mask, now.task)
        nothing = _outcome(
            now,
            torch.zeros(len(mask), len(EVENTS), dtype=torch.bool, device=mask.device),
            phase=torch.full_like(keys, StepEvent.NONE),
            progress=torch.zeros_like(judged.yaw),
            alignment=heading_alignment(now.task.target[:, 1:]),
        )
        if first:
            now.outcome = nothing
            now.terminated, now.truncated = torch.zeros_like(mask), torch.zeros_like(mask)
        else:
            now.outcome = nothing.where(mask.squeeze(-1), now.outcome)
            now.terminated, now.truncated = now.terminated & ~mask, now.truncated & ~mask

    def advance(self, now: StepState, invalid: Tensor, active: Tensor | None, keys: Tensor) -> None:
        """Computes the outcome of the step just made, the next targets, the counters and the endings.

        Args:
            now: state of the environment, after the step.
            invalid: rows whose action was not finite, bool ``[N, 1]``.
            active: rows that took the step, bool ``[N, 1]``; ``None``: all. The others keep what they had.
            keys: keys of the episodes, ``[N, 1]``.
        """
        before, judged = now.task, now.judged
        nearest = judged.readings.amin(-1, keepdim=True)
        steps = before.steps + 1
        collision_steps = (before.collision_steps + 1) * (nearest < self._task.collision_threshold)
        target = target_info(judged.position, judged.yaw, before.goal)
        events, phase = compute_terminations(
            position=judged.position,
            tilt=judged.euler[:, :2],
            distance=target[:, :1],
            displacement=self._history.displacement(judged.position, steps, active),
            collision_steps=collision_steps,
            invalid=invalid,
            bounds=(self._placement.bounds_low, self._placement.bounds_high),
            config=self._task,
        )
        after = TaskState(
            goal=before.goal,
            target=target,
            goals=before.goals,
            collision_steps=collision_steps,
            steps=steps,
            total_steps=before.total_steps + 1,
        )
        if not self._end_on_goal:
            after = self._next_goals(now, after, phase == StepEvent.GOAL, keys)
        now.task = after if active is None else after.merge(active, before)
        outcome = _outcome(
            now,
            events,
            phase=phase,
            progress=before.target[:, :1] - target[:, :1],
            alignment=heading_alignment(target[:, 1:]),
        )
        if active is not None:
            outcome = outcome.where(active.squeeze(-1), now.outcome)
            outcome.set("phase", phase.masked_fill(~active, StepEvent.NONE))
        now.outcome = outcome
        self._end(now, active)

    def _end(self, now: StepState, active: Tensor | None) -> None:
        """Sets ``terminated`` and ``truncated`` from the outcome and the number of steps."""
        terminated = now.outcome.get("phase") < StepEvent.GOAL
        if self._end_on_goal:
            terminated = terminated | now.outcome.get("goal_reached")
        truncated = (now.task.steps >= self.length) & ~terminated
        if active is not None:
            terminated = torch.where(active, terminated, now.terminated)
            truncated = torch.where(active, truncated, now.truncated)
        now.terminated, now.truncated = terminated, truncated

    def _next_goals(self, now: StepState, state: TaskState, reached: Tensor, keys: Tensor) -> TaskState:
        """Gives the rows that reached their goal a new one, from which progress counts anew."""
        # On the CPU this check is cheap and mostly spares the rest; on an accelerator it would wait for the device.
        if reached.device.type == "cpu" and not reached.any():
            return state
        judged = now.judged
        drawn = self._placement.draw_goal(keys, state.goals, judged.position)
        goal = torch.where(reached, drawn, state.goal)
        target = target_info(judged.position, judged.yaw, goal)
        return replace(state, goal=goal, target=target, goals=state.goals + reached)


def _outcome(now: StepState, events: Tensor, *, phase: Tensor, progress: Tensor, alignment: Tensor) -> TensorDict:
    return pack_outcome(
        events,
        phase=phase,
        progress=progress,
        alignment=alignment,
        linear_velocity=now.judged.rover.linear_velocity,
        angular_velocity=now.judged.rover.angular_velocity,
        steps=now.task.steps,
        total_steps=now.task.total_steps,
    )
