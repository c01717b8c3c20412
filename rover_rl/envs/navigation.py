"""Goals, events, outcome and end of the episode of every row."""

from __future__ import annotations

from dataclasses import replace

import torch
from tensordict import TensorDict
from torch import Tensor

from rover_rl.envs.config import EnvConfig
from rover_rl.envs.perception import Perception, StepState
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
    """Sets goals, and computes the outcome of each step from ``StepState.reference``.

    Args:
        config: description of the environment.
        placement: source of goals and of the bounds of each row's world.
        num_envs: number of rows.
        device: device of the rows.

    Attributes:
        length: number of steps after which an episode is truncated.
    """

    def __init__(self, config: EnvConfig, placement: Placement, num_envs: int, device: torch.device) -> None:
        self._task, self.length, self._end_on_goal = config.task, config.length, config.end_on_goal
        self._placement = placement
        self._history = PositionHistory(num_envs, config.task.stuck_window, device)

    def begin(self, state: StepState, mask: Tensor, goal: Tensor | None, keys: Tensor, first: bool) -> None:
        """Begins new episodes: sets goals, resets counters and clears the outcome.

        Args:
            state: state of the environment after the reset of these rows. It is updated in place.
            mask: rows that begin an episode, bool ``[N, 1]``.
            goal: goals, ``[N, 2]``, m. ``None`` draws them.
            keys: random keys of the episodes, ``[N, 1]``.
            first: whether this is the first reset since the simulator was built.
        """
        zeros = torch.zeros_like(keys)
        reference = state.reference
        if goal is None:
            goal = self._placement.draw_goal(keys, zeros, reference.position, mask)
        initial = TaskState(
            goal=goal,
            target=target_info(reference.position, reference.yaw, goal),
            goals=zeros + 1,
            collision_steps=zeros,
            steps=zeros,
            total_steps=state.task.total_steps,
        )
        state.task = initial.merge(mask, state.task)
        outcome = _outcome(
            state,
            torch.zeros(len(mask), len(EVENTS), dtype=torch.bool, device=mask.device),
            phase=torch.full_like(keys, StepEvent.NONE),
            progress=torch.zeros_like(reference.yaw),
            alignment=heading_alignment(state.task.target[:, 1:]),
        )
        if first:
            state.outcome = outcome
            state.terminated, state.truncated = torch.zeros_like(mask), torch.zeros_like(mask)
        else:
            state.outcome = outcome.where(mask.squeeze(-1), state.outcome)
            state.terminated, state.truncated = state.terminated & ~mask, state.truncated & ~mask

    def advance(self, state: StepState, invalid: Tensor, active: Tensor | None, keys: Tensor) -> None:
        """Updates targets and counters after a step, and computes its outcome and the ends of episodes.

        Args:
            state: state of the environment after the step. It is updated in place.
            invalid: rows whose action was not finite, bool ``[N, 1]``.
            active: rows that took the step, bool ``[N, 1]``. The other rows do not change. ``None`` means all rows.
            keys: random keys of the episodes, ``[N, 1]``.
        """
        previous, reference = state.task, state.reference
        steps = previous.steps + 1
        collision_steps = (previous.collision_steps + 1) * self._in_collision(reference)
        target = target_info(reference.position, reference.yaw, previous.goal)
        events, phase = compute_terminations(
            position=reference.position,
            tilt=reference.euler[:, :2],
            distance=target[:, :1],
            displacement=self._history.displacement(reference.position, steps, active),
            collision_steps=collision_steps,
            invalid=invalid,
            bounds=(self._placement.bounds_low, self._placement.bounds_high),
            config=self._task,
        )
        task = TaskState(
            goal=previous.goal,
            target=target,
            goals=previous.goals,
            collision_steps=collision_steps,
            steps=steps,
            total_steps=previous.total_steps + 1,
        )
        if not self._end_on_goal:
            task = self._next_goals(state, task, phase == StepEvent.GOAL, keys)
        state.task = task if active is None else task.merge(active, previous)
        outcome = _outcome(
            state,
            events,
            phase=phase,
            progress=previous.target[:, :1] - target[:, :1],
            alignment=heading_alignment(target[:, 1:]),
        )
        if active is not None:
            outcome = outcome.where(active.squeeze(-1), state.outcome)
            outcome.set("phase", phase.masked_fill(~active, StepEvent.NONE))
        state.outcome = outcome
        self._end(state, active)

    def _in_collision(self, reference: Perception) -> Tensor:
        """Returns which rovers are in collision, bool ``[N, 1]``."""
        if self._task.collision_from == "contact":
            # RoverEnv refuses simulators without contacts for this task.
            assert reference.rover.contact is not None
            return reference.rover.contact
        return reference.readings.amin(-1, keepdim=True) < self._task.collision_threshold

    def _end(self, state: StepState, active: Tensor | None) -> None:
        """Sets ``terminated`` and ``truncated`` from the outcome and the number of steps."""
        terminated = state.outcome.get("phase") < StepEvent.GOAL
        if self._end_on_goal:
            terminated = terminated | state.outcome.get("goal_reached")
        truncated = (state.task.steps >= self.length) & ~terminated
        if active is not None:
            terminated = torch.where(active, terminated, state.terminated)
            truncated = torch.where(active, truncated, state.truncated)
        state.terminated, state.truncated = terminated, truncated

    def _next_goals(self, state: StepState, task: TaskState, reached: Tensor, keys: Tensor) -> TaskState:
        """Draws a new goal for the rows that reached theirs, and computes the target to it."""
        # On the CPU this check is cheap and usually saves the work below. On an accelerator it would synchronize.
        if reached.device.type == "cpu" and not reached.any():
            return task
        reference = state.reference
        drawn = self._placement.draw_goal(keys, task.goals, reference.position, reached)
        goal = torch.where(reached, drawn, task.goal)
        target = target_info(reference.position, reference.yaw, goal)
        return replace(task, goal=goal, target=target, goals=task.goals + reached)


def _outcome(state: StepState, events: Tensor, *, phase: Tensor, progress: Tensor, alignment: Tensor) -> TensorDict:
    return pack_outcome(
        events,
        phase=phase,
        progress=progress,
        alignment=alignment,
        linear_velocity=state.reference.rover.linear_velocity,
        angular_velocity=state.reference.rover.angular_velocity,
        steps=state.task.steps,
        total_steps=state.task.total_steps,
        **({} if state.world is None else {"world": state.world}),
    )
