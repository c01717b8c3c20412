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
from dataclasses import dataclass, replace
from enum import IntEnum

import torch
from tensordict import TensorDict
from torch import Tensor

from rover_rl.envs.config import EnvConfig, TaskConfig
from rover_rl.envs.perception import Perception, SensedPose
from rover_rl.envs.placement import Placement
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


@dataclass
class TaskState:
    """State of the task of every row between steps.

    Attributes:
        goal: position of the goal, ``[N, 2]``, m.
        target: distance (m) and relative angle (rad) to the goal, ``[N, 2]``, unclipped.
        goals: number of goals set in the episode, int64 ``[N, 1]``.
        collision_steps: number of consecutive steps in collision, int64 ``[N, 1]``.
        steps: number of steps in the episode, int64 ``[N, 1]``.
        total_steps: number of steps of the row since it was last seeded, int64 ``[N, 1]``.
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


class StepState:
    """State of the environment between two steps.

    This is a plain object because ``EnvBase`` is a ``torch.nn.Module``, in which assigning attributes is slow.

    Attributes:
        truth: perception from the true state of the simulator.
        sensed: perception from the sensor readings. The same object as ``truth`` if there is no sensor noise.
        pose: pose as the sensors report it.
        reference: the one of ``truth`` and ``sensed`` that events and rewards are computed from.
        task: goals, targets and counters.
        world: index of each row's world in the pool, int64 ``[N, 1]``. ``None`` if there is only one.
        movers: entries of ``outcome`` on movers. Empty if no world has any.
        world_steps: number of steps since the worlds of groups changed, at which episodes are truncated, int64
            ``[N, 1]``. ``None`` if groups do not change worlds.
        outcome: events and measurements of the last step.
        terminated, truncated: whether the last step ended the episode, bool ``[N, 1]``.
    """

    truth: Perception
    sensed: Perception
    pose: SensedPose
    reference: Perception
    task: TaskState
    world: Tensor | None
    movers: dict[str, Tensor]
    world_steps: Tensor | None
    outcome: TensorDict
    terminated: Tensor
    truncated: Tensor

    def __init__(self, task: TaskState, world: Tensor | None) -> None:
        self.task = task
        self.world, self.movers, self.world_steps = world, {}, None


class Navigation:
    """Sets goals, and computes the outcome of each step from ``StepState.reference``.

    Args:
        config: description of the environment.
        placement: source of goals and of the bounds of each row's world.
        fleet: robots of the rows, whose outlines tell collisions if the task states no threshold.

    Attributes:
        length: number of steps after which an episode is truncated.
    """

    def __init__(self, config: EnvConfig, placement: Placement, fleet: Fleet) -> None:
        self._task, self.length, self._end_on_goal = config.task, config.length, config.end_on_goal
        self._placement, self._fleet = placement, fleet
        # Reading below which a rover is in collision, of all beams or of each robot and beam. Of all, pooled ones do.
        self._threshold, self._ranges = config.task.collision_threshold, torch.empty(0)
        if self._threshold is None:
            self._ranges = fleet.table(lambda robot: collision_ranges(robot, config.lidar.beams).tolist())
        self._history = PositionHistory(len(fleet), config.task.stuck_window, fleet.index.device)

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
            goal = self._placement.draw_goal(keys, zeros, reference.position, mask, state.task.goal)
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
        if self._threshold is None:
            ranges = self._ranges[self._fleet.index] if len(self._ranges) > 1 else self._ranges
            return (reference.ranges < ranges).any(-1, keepdim=True)
        return reference.readings.amin(-1, keepdim=True) < self._threshold

    def _end(self, state: StepState, active: Tensor | None) -> None:
        """Sets ``terminated`` and ``truncated`` from the outcome and the number of steps."""
        terminated = state.outcome.get("phase") < StepEvent.GOAL
        if self._end_on_goal:
            terminated = terminated | state.outcome.get("goal_reached")
        steps = state.task.steps if state.world_steps is None else state.world_steps
        truncated = (steps >= self.length) & ~terminated
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
        drawn = self._placement.draw_goal(keys, task.goals, reference.position, reached, task.goal)
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
        **state.movers,
    )
