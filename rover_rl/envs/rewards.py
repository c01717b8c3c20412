"""Rewards as TorchRL transforms: one per component, and their sum.

A component of the contract's reward is active in the rows whose step is decided by its event (``outcome["phase"]``), so
that the sum equals the contract's ``task_reward``. To remove or reweight a component or to add your own, pass a list of
components to :func:`rover_rl.make_env`.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import lru_cache, reduce
from typing import Any, ClassVar

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Composite, TensorSpec, Unbounded
from torchrl.envs.transforms import Transform

from rover_rl.envs.config import RewardConfig
from rover_rl.envs.task import StepEvent
from rover_rl.registry import Registry
from rover_rl.rotations import wrap_angle
from rover_rl.tensordicts import in_rows, unchecked_tensordict

STANDSTILL = 0.05
"""Speed below which a rover stands still, m/s."""
_LAST_ACTION = "last_action"


class RewardComponent(Transform):
    """Base class of reward components. The value is written to ``("reward_components", name)``.

    Subclasses define ``name``, ``phases`` and :meth:`value`.

    Attributes:
        name: name of the component.
        phases: events in which the component is active. Empty means every step.

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
        """Returns the value of the component in active rows: one number for all rows, or ``[N, 1]``.

        Args:
            outcome: events and measurements of the step, see :mod:`rover_rl.envs.task`.
            observation: result of the step, including the observation. An unbatched environment has one row.
        """

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        rows = in_rows(next_tensordict)
        outcome = rows.get("outcome")
        phase, value = outcome.get("phase"), self.value(outcome, rows)
        value = value.float() if isinstance(value, Tensor) else _number(value, phase.device)
        value = torch.where(self._active(phase), value, _number(0.0, phase.device))
        components = next_tensordict.get("reward_components", None)
        if components is None:
            components = unchecked_tensordict({}, next_tensordict.batch_size, next_tensordict.device)
            next_tensordict.set("reward_components", components)
        components.set(self.name, value if next_tensordict.batch_dims else value[0])
        return next_tensordict

    def _active(self, phase: Tensor) -> Tensor:
        if not self.phases:
            return phase != StepEvent.NONE
        return reduce(torch.logical_or, (phase == active for active in self.phases))

    def transform_output_spec(self, output_spec: Composite) -> Composite:
        """Adds the component to the output spec."""
        # TorchRL copies the specs of the environment for all transforms, and again in each transform. The copies in the
        # components would take most of the time of the first reset.
        output_spec["full_observation_spec"] = self.transform_observation_spec(output_spec["full_observation_spec"])
        output_spec["full_reward_spec"] = self.transform_reward_spec(output_spec["full_reward_spec"])
        output_spec["full_done_spec"] = self.transform_done_spec(output_spec["full_done_spec"])
        return output_spec

    def transform_reward_spec(self, reward_spec: TensorSpec) -> TensorSpec:
        """Adds the component to the reward spec."""
        # Not those of `parent`, for which TorchRL builds an environment anew in each transform.
        shape, device = reward_spec.shape, reward_spec.device
        components = reward_spec.get("reward_components", None)
        if components is None:
            components = Composite(shape=shape, device=device)
        components[self.name] = Unbounded(shape=(*shape, 1), device=device)
        reward_spec["reward_components"] = components
        return reward_spec


@lru_cache(maxsize=256)
def _number(value: float, device: torch.device) -> Tensor:
    """Returns a number as a tensor. :func:`torch.where` would copy a Python number to the device in every step."""
    return torch.tensor(value, dtype=torch.float32, device=device)


class _ConfiguredComponent(RewardComponent):
    """Component that is a dataclass: its fields are parameters with the names and defaults of :class:`RewardConfig`."""

    def __post_init__(self) -> None:
        super().__init__()

    @classmethod
    def from_config(cls, config: RewardConfig) -> RewardComponent:
        """Creates the component with its parameters in a configuration."""
        return cls(**{field.name: getattr(config, field.name) for field in fields(cls)})


@dataclass(eq=False, repr=False)
class GoalReward(_ConfiguredComponent):
    """Reward for reaching a goal."""

    name = "goal"
    phases = (StepEvent.GOAL,)
    goal_reward: float = RewardConfig.goal_reward

    def value(self, outcome: TensorDictBase, observation: TensorDictBase) -> float:
        """Returns ``goal_reward``."""
        return self.goal_reward


@dataclass(eq=False, repr=False)
class ProgressReward(_ConfiguredComponent):
    """Reward for progress toward the goal, or idle penalty if there is too little or the rover faces away."""

    name = "progress"
    phases = (StepEvent.DENSE,)
    distance_delta_scale: float = RewardConfig.distance_delta_scale
    final_reward_multiplier: float = RewardConfig.final_reward_multiplier
    idle_penalty: float = RewardConfig.idle_penalty
    min_progress: float = RewardConfig.min_progress
    min_alignment: float = RewardConfig.min_alignment

    def value(self, outcome: TensorDictBase, observation: TensorDictBase) -> Tensor:
        """Returns ``final_reward_multiplier * (distance_delta_scale * progress or idle_penalty)``."""
        progress = outcome.get("progress")
        counts = (progress.abs() > self.min_progress) & (outcome.get("alignment") > self.min_alignment)
        multiplier = self.final_reward_multiplier
        return torch.where(counts, progress * (multiplier * self.distance_delta_scale), multiplier * self.idle_penalty)


@dataclass(eq=False, repr=False)
class VelocityBonus(_ConfiguredComponent):
    """Reward proportional to the forward speed from wheel odometry."""

    name = "velocity"
    phases = (StepEvent.DENSE,)
    velocity_scale: float = RewardConfig.velocity_scale

    def value(self, outcome: TensorDictBase, observation: TensorDictBase) -> Tensor:
        """Returns ``velocity_scale * v``."""
        return outcome.get("linear_velocity") * self.velocity_scale


@dataclass(eq=False, repr=False)
class TurnPenalty(_ConfiguredComponent):
    """Penalty proportional to the absolute yaw rate from wheel odometry."""

    name = "turn"
    phases = (StepEvent.DENSE,)
    turn_scale: float = RewardConfig.turn_scale

    def value(self, outcome: TensorDictBase, observation: TensorDictBase) -> Tensor:
        """Returns ``turn_scale * |w|``."""
        return outcome.get("angular_velocity").abs() * self.turn_scale


@dataclass(eq=False, repr=False)
class CollisionPenalty(_ConfiguredComponent):
    """Penalty for each step with a lidar reading below the collision threshold."""

    name = "collision"
    phases = (StepEvent.COLLISION,)
    collision_penalty: float = RewardConfig.collision_penalty

    def value(self, outcome: TensorDictBase, observation: TensorDictBase) -> float:
        """Returns ``collision_penalty``."""
        return self.collision_penalty


@dataclass(eq=False, repr=False)
class StuckPenalty(_ConfiguredComponent):
    """Penalty for an episode that ends because the rover is stuck."""

    name = "stuck"
    phases = (StepEvent.STUCK,)
    stuck_penalty: float = RewardConfig.stuck_penalty

    def value(self, outcome: TensorDictBase, observation: TensorDictBase) -> float:
        """Returns ``stuck_penalty``."""
        return self.stuck_penalty


@dataclass(eq=False, repr=False)
class GeneralPenalty(_ConfiguredComponent):
    """Penalty for an episode that ends in a jam, or in a flip after the first ``flip_grace_steps`` steps."""

    name = "general"
    phases = (StepEvent.FLIP, StepEvent.JAM)
    general_penalty: float = RewardConfig.general_penalty
    flip_grace_steps: int = RewardConfig.flip_grace_steps

    def value(self, outcome: TensorDictBase, observation: TensorDictBase) -> Tensor:
        """Returns the penalty, or 0 for a flip in the first ``flip_grace_steps`` steps."""
        early_flip = (outcome.get("phase") == StepEvent.FLIP) & (outcome.get("steps") <= self.flip_grace_steps)
        return torch.where(early_flip, 0.0, self.general_penalty)


@dataclass(eq=False, repr=False)
class OutOfBoundsPenalty(_ConfiguredComponent):
    """Penalty for an episode that ends because the rover leaves the world's bounds."""

    name = "out_of_bounds"
    phases = (StepEvent.OUT_OF_BOUNDS,)
    out_of_bounds_penalty: float = RewardConfig.out_of_bounds_penalty

    def value(self, outcome: TensorDictBase, observation: TensorDictBase) -> float:
        """Returns ``out_of_bounds_penalty``."""
        return self.out_of_bounds_penalty


@dataclass(eq=False, repr=False)
class ClearancePenalty(_ConfiguredComponent):
    """Penalty that grows as the nearest lidar reading falls below a distance. Not a part of the contract.

    With the nearest reading ``d`` of the observation and the distance ``D``, the value is

        ``clearance_penalty * max(0, 1 - d / D)``

    in every step. This is the form of C. Chen, Y. Liu, S. Kreiss, A. Alahi, "Crowd-robot interaction", ICRA 2019
    (arXiv:1809.08835): ``-0.1 + d / 2`` for ``d < 0.2``, that is a penalty of -0.1 and a distance of 0.2 m. There,
    ``d`` is the gap between two bodies; here it is measured from the lidar, so that ``D`` must exceed the distance from
    the lidar to the outline of the rover.

    Args:
        clearance_penalty: reward for each step with a reading of 0.
        clearance_distance: reading below which the penalty applies, m.
    """

    name = "clearance"
    clearance_penalty: float
    clearance_distance: float = RewardConfig.clearance_distance

    def value(self, outcome: TensorDictBase, observation: TensorDictBase) -> Tensor:
        """Returns ``clearance_penalty * max(0, 1 - d / clearance_distance)``."""
        nearest = observation.get("lidar").amin(-1, keepdim=True)
        return self.clearance_penalty * (1 - nearest / self.clearance_distance).clamp_min(0)


@dataclass(eq=False, repr=False)
class ActionRatePenalty(_ConfiguredComponent):
    """Penalty for changes of the action between steps. Not a part of the contract.

    The value is ``action_rate_penalty * |a_t - a_(t-1)|^2`` in every step but the first of an episode, with actions in
    m/s and rad, and the change of the heading offset wrapped to (-pi, pi]. This is the action rate penalty of
    N. Rudin, D. Hoeller, P. Reist, M. Hutter, "Learning to walk in minutes using massively parallel deep reinforcement
    learning", CoRL 2021 (arXiv:2109.11978).

    The transform adds ``last_action``, the action of the last step, ``[N, 2]``, 0 after a reset. An action that
    :class:`~rover_rl.envs.transforms.action_repeat.ActionRepeat` repeats changes once.

    Args:
        action_rate_penalty: reward for each squared change.
    """

    name = "action_rate"
    action_rate_penalty: float

    def value(self, outcome: TensorDictBase, observation: TensorDictBase) -> Tensor:
        """Returns ``action_rate_penalty * |a_t - a_(t-1)|^2``, or 0 in the first step of an episode."""
        squared = self._change.square().sum(-1, keepdim=True)
        return (self.action_rate_penalty * squared).masked_fill(outcome.get("steps") <= 1, 0.0)

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        # On a GPU, an action that is not finite ends the episode without an error.
        action = torch.nan_to_num(tensordict.get("action"))
        last = tensordict.get(_LAST_ACTION, action)
        speed, heading = (action - last).split(1, -1)
        self._change = torch.cat((speed, wrap_angle(heading)), -1)
        moved = next_tensordict.get(("outcome", "phase")) != StepEvent.NONE
        next_tensordict.set(_LAST_ACTION, torch.where(moved, action, last))
        return super()._step(tensordict, next_tensordict)

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        return tensordict_reset.set(_LAST_ACTION, torch.zeros_like(tensordict_reset.get("velocities")))

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        """Adds ``last_action``."""
        batch_size, device = self.parent.batch_size, self.parent.device
        observation_spec[_LAST_ACTION] = Unbounded(shape=(*batch_size, 2), device=device)
        return observation_spec


@dataclass(eq=False, repr=False)
class MoverContactPenalty(_ConfiguredComponent):
    """Penalty for contacts with movers, by whose fault they are. Not a part of the contract.

    A rover whose wheels turned by less than 0.05 m/s before the step has been run into. In worlds without movers, the
    value is 0.

    Args:
        mover_contact_penalty: reward for each step in contact with a mover that the rover drove into.
        struck_penalty: reward for each step in contact with a mover that ran into the standing rover.
    """

    name = "mover_contact"
    mover_contact_penalty: float = RewardConfig.mover_contact_penalty
    struck_penalty: float = RewardConfig.struck_penalty

    def value(self, outcome: TensorDictBase, observation: TensorDictBase) -> Tensor | float:
        """Returns the penalty of the contact, or 0 without one."""
        contact = outcome.get("mover_contact", None)
        if contact is None:
            return 0.0
        penalty = torch.where(self._speed.abs() < STANDSTILL, self.struck_penalty, self.mover_contact_penalty)
        return torch.where(contact, penalty, 0.0)

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        # The mover pushes the rover in the step of the contact.
        self._speed = in_rows(tensordict).get("outcome").get("linear_velocity")
        return super()._step(tensordict, next_tensordict)


@dataclass(eq=False, repr=False)
class MoverProximityPenalty(_ConfiguredComponent):
    """Penalty for being close to movers, and for driving fast there. Not a part of the contract.

    With the distance ``d`` from the center of the rover to the surface of the nearest mover, ``D`` the
    ``intrusion_distance``, and the speed ``v`` of the wheels, the value is

        ``(intrusion_penalty + haste_penalty |v|) max(0, 1 - d / D) + risk_penalty [d < risk_distance]``

    in every step, and 0 in worlds without movers. People keep others out of 1.2 m (Hall, "The Hidden Dimension", 1966).

    Args:
        intrusion_penalty: reward for each step at a mover.
        haste_penalty: reward for each step at a mover at 1 m/s.
        risk_penalty: reward for each step within ``risk_distance``.
        intrusion_distance: distance from which on the rover does not intrude, m.
        risk_distance: distance within which it is at risk, m.
    """

    name = "mover_proximity"
    intrusion_penalty: float = RewardConfig.intrusion_penalty
    haste_penalty: float = RewardConfig.haste_penalty
    risk_penalty: float = RewardConfig.risk_penalty
    intrusion_distance: float = RewardConfig.intrusion_distance
    risk_distance: float = RewardConfig.risk_distance

    def value(self, outcome: TensorDictBase, observation: TensorDictBase) -> Tensor | float:
        """Returns the penalty."""
        distance = outcome.get("mover_distance", None)
        if distance is None:
            return 0.0
        near = (1 - distance / self.intrusion_distance).clamp_min(0)
        rate = self.intrusion_penalty + self.haste_penalty * outcome.get("linear_velocity").abs()
        return rate * near + self.risk_penalty * (distance < self.risk_distance)


class TotalReward(Transform):
    """Writes the sum of all reward components to ``reward``. Append it after the components."""

    def transform_output_spec(self, output_spec: Composite) -> Composite:
        """Returns the output spec, in which the environment already has ``reward``."""
        return output_spec

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        components = next_tensordict.get("reward_components", None)
        if components is None:
            raise RuntimeError("TotalReward found no reward components; append it after at least one RewardComponent")
        next_tensordict.set("reward", torch.cat(list(components.values()), -1).sum(-1, keepdim=True))
        return next_tensordict


def contract_reward(config: RewardConfig | None = None) -> list[Transform]:
    """Returns the components of the contract's reward, without :class:`TotalReward`.

    Args:
        config: parameters of the reward. ``None`` uses the contract's. The components that are not a part of the
            contract are left out if their penalty is 0.

    Example:
        >>> [component.name for component in contract_reward()]
        ['goal', 'progress', 'velocity', 'turn', 'collision', 'stuck', 'general', 'out_of_bounds']
    """
    config = config or RewardConfig()
    kinds: list[type[_ConfiguredComponent]] = [*_CONTRACT]
    if config.clearance_penalty:
        kinds.append(ClearancePenalty)
    if config.action_rate_penalty:
        kinds.append(ActionRatePenalty)
    if config.mover_contact_penalty or config.struck_penalty:
        kinds.append(MoverContactPenalty)
    if config.intrusion_penalty or config.haste_penalty or config.risk_penalty:
        kinds.append(MoverProximityPenalty)
    return [kind.from_config(config) for kind in kinds]


_CONTRACT = (
    *(GoalReward, ProgressReward, VelocityBonus, TurnPenalty),
    *(CollisionPenalty, StuckPenalty, GeneralPenalty, OutOfBoundsPenalty),
)
_REGISTRY = Registry("reward", {"contract": contract_reward, "task": list})


def register_reward(name: str, reward: Any) -> None:
    """Registers a reward under a name, for ``make_env``, ``EnvConfig`` and ``--reward``.

    Args:
        name: new name of letters, digits, ``_``, ``-`` and ``.``.
        reward: :class:`RewardComponent` class or object, list of them, :class:`RewardConfig`, function without
            arguments that returns one of these, or ``"module:attribute"`` of any of these.

    Raises:
        ValueError: if the name is taken or has other characters.
    """
    _REGISTRY.register(name, reward)


def reward_names() -> list[str]:
    """Returns the names of all rewards: built-in, registered, and from installed packages."""
    return _REGISTRY.names()


def reward_components(reward: Any, contract: RewardConfig | None = None) -> list[Transform]:
    """Creates the components of a reward. The list is empty for the reward of the bare task.

    Args:
        reward: name in :func:`reward_names`, ``"module:attribute"`` of your own reward, a :class:`RewardConfig`, a
            :class:`RewardComponent`, or a sequence of these, which are added up.
        contract: parameters of the contract's reward. ``None`` uses the contract's.

    Raises:
        ValueError: if the reward is unknown or of another type.

    Example:
        >>> [component.name for component in reward_components("contract")][:2]
        ['goal', 'progress']
    """
    if reward == "contract":
        return contract_reward(contract)
    part = _REGISTRY.find(reward) if isinstance(reward, str) else reward
    if callable(part) and not isinstance(part, Transform):
        part = _REGISTRY.call(str(reward), part)
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
