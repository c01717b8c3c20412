"""The contract's reward: one transform per component, and their sum.

A component is active where its rule decides the step (``outcome["phase"]``), so that the sum is exactly the contract's
``task_reward``. Drop one, weigh it otherwise or add your own by choosing the transforms; see :func:`rover_rl.make_env`.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from typing import Any, ClassVar

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Composite, TensorSpec, Unbounded
from torchrl.envs.transforms import Transform

from rover_rl.envs.config import RewardConfig
from rover_rl.envs.rows import in_rows
from rover_rl.envs.task import StepEvent
from rover_rl.registry import Registry
from rover_rl.tensordicts import unchecked_tensordict


class RewardComponent(Transform):
    """One component of the reward, written to ``("reward_components", name)``.

    Subclasses give a :attr:`name`, the :attr:`phases` in which they are active (none given: in every step), and
    :meth:`value`.

    Example:
        >>> class TiltPenalty(RewardComponent):
        ...     name = "tilt"
        ...
        ...     def value(self, outcome, observation):
        ...         return -0.1 * observation["imu"][:, :2].abs().sum(-1, keepdim=True)
    """

    name: ClassVar[str]
    phases: ClassVar[tuple[StepEvent, ...]] = ()

    @abstractmethod
    def value(self, outcome: TensorDictBase, observation: TensorDictBase) -> Tensor | float:
        """The component where it is active: one number for all rows, or one a row, ``[N, 1]``.

        Args:
            outcome: what happened in the step.
            observation: the whole step's result, the observation in it. An unbatched environment's has one row.
        """

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        rows = in_rows(next_tensordict)
        outcome = rows.get("outcome")
        value = torch.where(self._active(outcome.get("phase")), self.value(outcome, rows), 0.0)
        components = next_tensordict.get("reward_components", None)
        if components is None:
            components = unchecked_tensordict({}, next_tensordict.batch_size, next_tensordict.device)
            next_tensordict.set("reward_components", components)
        components.set(self.name, value if next_tensordict.batch_dims else value[0])
        return next_tensordict

    def _active(self, phase: Tensor) -> Tensor:
        if not self.phases:
            return phase != StepEvent.NONE
        active = phase == self.phases[0]
        for other in self.phases[1:]:
            active = active | (phase == other)
        return active

    def transform_reward_spec(self, reward_spec: TensorSpec) -> TensorSpec:
        """Adds the component to the reward spec."""
        parent = self.parent
        components = reward_spec.get("reward_components", None)
        if components is None:
            components = Composite(shape=parent.batch_size, device=parent.device)
        components[self.name] = Unbounded(shape=(*parent.batch_size, 1), device=parent.device)
        reward_spec["reward_components"] = components
        return reward_spec


class GoalReward(RewardComponent):
    """``goal_reward`` for reaching a goal."""

    name = "goal"
    phases = (StepEvent.GOAL,)

    def __init__(self, goal_reward: float = RewardConfig.goal_reward) -> None:
        super().__init__()
        self.goal_reward = goal_reward

    def value(self, outcome: TensorDictBase, observation: TensorDictBase) -> float:
        """The reward itself."""
        return self.goal_reward


class ProgressReward(RewardComponent):
    """Metres gained on the target, or the idle penalty where too little is gained or the rover faces away."""

    name = "progress"
    phases = (StepEvent.DENSE,)

    def __init__(
        self,
        distance_delta_scale: float = RewardConfig.distance_delta_scale,
        final_reward_multiplier: float = RewardConfig.final_reward_multiplier,
        idle_penalty: float = RewardConfig.idle_penalty,
        min_progress: float = RewardConfig.min_progress,
        min_alignment: float = RewardConfig.min_alignment,
    ) -> None:
        super().__init__()
        self.distance_delta_scale = distance_delta_scale
        self.final_reward_multiplier = final_reward_multiplier
        self.idle_penalty = idle_penalty
        self.min_progress = min_progress
        self.min_alignment = min_alignment

    def value(self, outcome: TensorDictBase, observation: TensorDictBase) -> Tensor:
        """``multiplier * (scale * progress or idle penalty)``."""
        progress = outcome.get("progress")
        counts = (progress.abs() > self.min_progress) & (outcome.get("alignment") > self.min_alignment)
        multiplier = self.final_reward_multiplier
        return torch.where(counts, progress * (multiplier * self.distance_delta_scale), multiplier * self.idle_penalty)


class VelocityBonus(RewardComponent):
    """``velocity_scale`` for each m/s forward, by wheel odometry."""

    name = "velocity"
    phases = (StepEvent.DENSE,)

    def __init__(self, velocity_scale: float = RewardConfig.velocity_scale) -> None:
        super().__init__()
        self.velocity_scale = velocity_scale

    def value(self, outcome: TensorDictBase, observation: TensorDictBase) -> Tensor:
        """``scale * v``."""
        return outcome.get("linear_velocity") * self.velocity_scale


class TurnPenalty(RewardComponent):
    """``turn_scale`` for each rad/s of turning, by wheel odometry."""

    name = "turn"
    phases = (StepEvent.DENSE,)

    def __init__(self, turn_scale: float = RewardConfig.turn_scale) -> None:
        super().__init__()
        self.turn_scale = turn_scale

    def value(self, outcome: TensorDictBase, observation: TensorDictBase) -> Tensor:
        """``scale * |w|``."""
        return outcome.get("angular_velocity").abs() * self.turn_scale


class CollisionPenalty(RewardComponent):
    """A penalty for each step with a lidar reading below the collision threshold."""

    name = "collision"
    phases = (StepEvent.COLLISION,)

    def __init__(self, collision_penalty: float = RewardConfig.collision_penalty) -> None:
        super().__init__()
        self.collision_penalty = collision_penalty

    def value(self, outcome: TensorDictBase, observation: TensorDictBase) -> float:
        """The penalty itself."""
        return self.collision_penalty


class StuckPenalty(RewardComponent):
    """A penalty for an episode that ends because the rover has not moved."""

    name = "stuck"
    phases = (StepEvent.STUCK,)

    def __init__(self, stuck_penalty: float = RewardConfig.stuck_penalty) -> None:
        super().__init__()
        self.stuck_penalty = stuck_penalty

    def value(self, outcome: TensorDictBase, observation: TensorDictBase) -> float:
        """The penalty itself."""
        return self.stuck_penalty


class GeneralPenalty(RewardComponent):
    """A penalty for an episode that ends in a jam, or in a flip that comes after ``flip_grace_steps``."""

    name = "general"
    phases = (StepEvent.FLIP, StepEvent.JAM)

    def __init__(
        self,
        general_penalty: float = RewardConfig.general_penalty,
        flip_grace_steps: int = RewardConfig.flip_grace_steps,
    ) -> None:
        super().__init__()
        self.general_penalty = general_penalty
        self.flip_grace_steps = flip_grace_steps

    def value(self, outcome: TensorDictBase, observation: TensorDictBase) -> Tensor:
        """The penalty, or 0 for an early flip."""
        forgiven = (outcome.get("phase") == StepEvent.FLIP) & (outcome.get("steps") <= self.flip_grace_steps)
        return torch.where(forgiven, 0.0, self.general_penalty)


class OutOfBoundsPenalty(RewardComponent):
    """A penalty for an episode that ends because the rover left the world's bounds."""

    name = "out_of_bounds"
    phases = (StepEvent.OUT_OF_BOUNDS,)

    def __init__(self, out_of_bounds_penalty: float = RewardConfig.out_of_bounds_penalty) -> None:
        super().__init__()
        self.out_of_bounds_penalty = out_of_bounds_penalty

    def value(self, outcome: TensorDictBase, observation: TensorDictBase) -> float:
        """The penalty itself."""
        return self.out_of_bounds_penalty


class TotalReward(Transform):
    """Writes the sum of all reward components into ``reward``; comes after them."""

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        components = next_tensordict.get("reward_components", None)
        if components is None:
            raise RuntimeError("TotalReward found no reward components; append it after at least one RewardComponent")
        next_tensordict.set("reward", torch.cat(list(components.values()), -1).sum(-1, keepdim=True))
        return next_tensordict


def contract_reward(config: RewardConfig | None = None) -> list[Transform]:
    """The contract's reward as transforms, one a component, without their sum.

    Args:
        config: its numbers.

    Example:
        >>> [component.name for component in contract_reward()]
        ['goal', 'progress', 'velocity', 'turn', 'collision', 'stuck', 'general', 'out_of_bounds']
    """
    c = config or RewardConfig()
    return [
        GoalReward(c.goal_reward),
        ProgressReward(
            c.distance_delta_scale, c.final_reward_multiplier, c.idle_penalty, c.min_progress, c.min_alignment
        ),
        VelocityBonus(c.velocity_scale),
        TurnPenalty(c.turn_scale),
        CollisionPenalty(c.collision_penalty),
        StuckPenalty(c.stuck_penalty),
        GeneralPenalty(c.general_penalty, c.flip_grace_steps),
        OutOfBoundsPenalty(c.out_of_bounds_penalty),
    ]


_REGISTRY = Registry("reward", {"contract": contract_reward, "task": list})


def register_reward(name: str, reward: Any) -> None:
    """Gives a reward a name, for ``make_env``, ``EnvConfig`` and ``--reward``.

    Args:
        name: its name.
        reward: a :class:`RewardComponent` class or object, a list of them, a :class:`RewardConfig`, a function without
            arguments that returns one of these, or the ``"module:attribute"`` of any.

    Raises:
        ValueError: for a name that is taken, or that has other characters than letters, digits, ``_``, ``-`` and ``.``.
    """
    _REGISTRY.register(name, reward)


def reward_names() -> list[str]:
    """Names of the rewards of the package, of those registered, and of those of installed packages."""
    return _REGISTRY.names()


def reward_components(reward: Any, contract: RewardConfig | None = None) -> list[Transform]:
    """The components of a reward, new objects each time; none for the bare task's reward.

    Args:
        reward: a name in :func:`reward_names`, the ``module:attribute`` of a reward of your own, a
            :class:`RewardConfig`, a :class:`RewardComponent`, or a sequence of these, which are put together.
        contract: numbers of the contract's reward.

    Raises:
        ValueError: for something else.

    Example:
        >>> [component.name for component in reward_components(["contract", "my_package:TiltPenalty"])][-1]
        'tilt'
    """
    if reward == "contract":
        return contract_reward(contract)
    part = _REGISTRY.find(reward) if isinstance(reward, str) else reward
    if callable(part) and not isinstance(part, Transform):
        part = part()
    if isinstance(part, RewardConfig):
        return contract_reward(part)
    if isinstance(part, Transform):
        # A transform belongs to one environment.
        return [part if part is reward and part.parent is None else part.clone()]
    if not isinstance(part, Sequence) or isinstance(part, str):
        raise ValueError(
            f"reward must be one of {reward_names()}, a RewardConfig, RewardComponents or a function that returns "
            f"them, got {part!r}"
        )
    return [component for each in part for component in reward_components(each, contract)]
