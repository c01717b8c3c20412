"""Rewards as TorchRL transforms: one per component, and their sum.

A component of the contract's reward is active in the rows whose step is decided by its event (``outcome["phase"]``), so
that the sum equals the contract's ``task_reward``. To remove or reweight a component or to add your own, pass a list of
components to :func:`rover_rl.make_env`.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Sequence
from functools import lru_cache, reduce
from typing import Any

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

    Subclasses define :meth:`value`, ``name``, and ``phases``, the events in which the component is active, if it is not
    so in every step. One that computes its value from the ``outcome`` alone says ``reads_observation = False``: see
    :class:`~rover_rl.envs.transforms.action_repeat.ActionRepeat`.

    Example:
        >>> class TiltPenalty(RewardComponent):
        ...     name = "tilt"
        ...
        ...     def value(self, outcome, observation):
        ...         return -0.1 * observation["imu"][:, :2].abs().sum(-1, keepdim=True)
    """

    name: str
    phases: tuple[StepEvent, ...] = ()

    @abstractmethod
    def value(self, outcome: TensorDictBase, observation: TensorDictBase) -> Tensor | float:
        """Returns the value of the component in active rows: one number for all rows, or ``[N, 1]``.

        It gets the ``outcome`` of the step (see :mod:`rover_rl.envs.task`) and, as ``observation``, the whole result of
        the step. An unbatched environment has one row.
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
        # TorchRL copies the specs of the environment for all transforms, and again in each transform. The copies in the
        # components would take most of the time of the first reset.
        for kind in ("observation", "reward", "done"):
            key = f"full_{kind}_spec"
            output_spec[key] = getattr(self, f"transform_{kind}_spec")(output_spec[key])
        return output_spec

    def transform_reward_spec(self, reward_spec: TensorSpec) -> TensorSpec:
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
    # torch.where() would copy a Python number to the device in every step.
    return torch.tensor(value, dtype=torch.float32, device=device)


def _progress(outcome: TensorDictBase, _: TensorDictBase, config: RewardConfig) -> Tensor:
    progress = outcome.get("progress")
    counts = (progress.abs() > config.min_progress) & (outcome.get("alignment") > config.min_alignment)
    multiplier = config.final_reward_multiplier
    idle = _number(multiplier * config.idle_penalty, progress.device)
    return torch.where(counts, progress * (multiplier * config.distance_delta_scale), idle)


def _general(outcome: TensorDictBase, _: TensorDictBase, config: RewardConfig) -> Tensor:
    early_flip = (outcome.get("phase") == StepEvent.FLIP) & (outcome.get("steps") <= config.flip_grace_steps)
    none, penalty = (_number(value, early_flip.device) for value in (0.0, config.general_penalty))
    return torch.where(early_flip, none, penalty)


def _clearance(outcome: TensorDictBase, observation: TensorDictBase, config: RewardConfig) -> Tensor:
    nearest = observation.get("lidar").amin(-1, keepdim=True)
    return config.clearance_penalty * (1 - nearest / config.clearance_distance).clamp_min(0)


def _mover_proximity(outcome: TensorDictBase, observation: TensorDictBase, config: RewardConfig) -> Tensor | float:
    distance = outcome.get("mover_distance", None)
    if distance is None:
        return 0.0
    near = (1 - distance / config.intrusion_distance).clamp_min(0)
    rate = config.intrusion_penalty + config.haste_penalty * outcome.get("linear_velocity").abs()
    return rate * near + config.risk_penalty * (distance < config.risk_distance)


Value = Callable[[TensorDictBase, TensorDictBase, RewardConfig], Tensor | float]

CONTRACT: dict[str, tuple[tuple[StepEvent, ...], Value]] = {
    "goal": ((StepEvent.GOAL,), lambda outcome, _, config: config.goal_reward),
    "progress": ((StepEvent.DENSE,), _progress),
    "velocity": ((StepEvent.DENSE,), lambda outcome, _, config: outcome.get("linear_velocity") * config.velocity_scale),
    "turn": ((StepEvent.DENSE,), lambda outcome, _, config: outcome.get("angular_velocity").abs() * config.turn_scale),
    "collision": ((StepEvent.COLLISION,), lambda outcome, _, config: config.collision_penalty),
    "stuck": ((StepEvent.STUCK,), lambda outcome, _, config: config.stuck_penalty),
    "general": ((StepEvent.FLIP, StepEvent.JAM), _general),
    "out_of_bounds": ((StepEvent.OUT_OF_BOUNDS,), lambda outcome, _, config: config.out_of_bounds_penalty),
}
"""Components of the contract's reward: the events that they are active in, and their values."""
SHAPING: dict[str, tuple[tuple[StepEvent, ...], Value]] = {
    "clearance": ((), _clearance),
    "mover_proximity": ((), _mover_proximity),
}
"""Components that are not a part of the contract, in every step.

- ``clearance``: ``clearance_penalty * max(0, 1 - d / D)`` with the nearest reading ``d`` of the observation and the
  ``clearance_distance`` ``D`` (C. Chen, Y. Liu, S. Kreiss, A. Alahi, "Crowd-robot interaction", ICRA 2019,
  arXiv:1809.08835). There, ``d`` is the gap between two bodies; here it is measured from the lidar, so that ``D`` must
  exceed the distance from the lidar to the outline of the rover.
- ``mover_proximity``: ``(intrusion_penalty + haste_penalty |v|) max(0, 1 - d / D) + risk_penalty [d < risk_distance]``
  with the distance ``d`` from the center of the rover to the surface of the nearest mover, the ``intrusion_distance``
  ``D``, and the speed ``v`` of the wheels; 0 in worlds without movers. People keep others out of 1.2 m (Hall, "The
  Hidden Dimension", 1966).
"""


class ConfiguredComponent(RewardComponent):
    """Component whose parameters are those of a :class:`RewardConfig`: one of :data:`CONTRACT` or :data:`SHAPING`."""

    def __init__(self, config: RewardConfig | None = None, name: str = "") -> None:
        super().__init__()
        self.config = config or RewardConfig()
        if name:
            self.name, (self.phases, self._value) = name, (CONTRACT | SHAPING)[name]
            self.reads_observation = name == "clearance"

    def value(self, outcome: TensorDictBase, observation: TensorDictBase) -> Tensor | float:
        return self._value(outcome, observation, self.config)


class ActionRatePenalty(ConfiguredComponent):
    """Penalty for changes of the action between steps. Not a part of the contract.

    The value is ``action_rate_penalty * |a_t - a_(t-1)|^2`` in every step but the first of an episode, with actions in
    m/s and rad, and the change of the heading offset wrapped to (-pi, pi] (N. Rudin, D. Hoeller, P. Reist, M. Hutter,
    "Learning to walk in minutes using massively parallel deep reinforcement learning", CoRL 2021, arXiv:2109.11978).
    The transform adds ``last_action``, the action of the last step, ``[N, A]``, 0 after a reset. An action that
    :class:`~rover_rl.envs.transforms.action_repeat.ActionRepeat` repeats changes once.
    """

    name, reads_observation = "action_rate", False

    def value(self, outcome: TensorDictBase, observation: TensorDictBase) -> Tensor:
        squared = self._change.square().sum(-1, keepdim=True)
        return (self.config.action_rate_penalty * squared).masked_fill(outcome.get("steps") <= 1, 0.0)

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        # On a GPU, an action that is not finite ends the episode without an error.
        action = torch.nan_to_num(tensordict.get("action"))
        last = tensordict.get(_LAST_ACTION, action)
        self._change = action - last
        if "command" not in tensordict:
            # The contract's action, whose second number is a heading.
            speed, heading, *sideways = self._change.split(1, -1)
            self._change = torch.cat((speed, wrap_angle(heading), *sideways), -1)
        moved = next_tensordict.get(("outcome", "phase")) != StepEvent.NONE
        next_tensordict.set(_LAST_ACTION, torch.where(moved, action, last))
        return super()._step(tensordict, next_tensordict)

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        return tensordict_reset.set(_LAST_ACTION, self.parent.full_action_spec["action"].zero())

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        spec = self.parent.full_action_spec["action"]
        observation_spec[_LAST_ACTION] = Unbounded(shape=spec.shape, device=spec.device)
        return observation_spec


class MoverContactPenalty(ConfiguredComponent):
    """Penalty for contacts with movers, one for those at fault of the rover and one for the others; 0 without movers.

    A rover whose wheels turned by less than 0.05 m/s before the step has been run into. Not a part of the contract.
    """

    name, reads_observation = "mover_contact", False

    def value(self, outcome: TensorDictBase, observation: TensorDictBase) -> Tensor | float:
        contact, config = outcome.get("mover_contact", None), self.config
        if contact is None:
            return 0.0
        penalty = torch.where(self._speed.abs() < STANDSTILL, config.struck_penalty, config.mover_contact_penalty)
        return torch.where(contact, penalty, 0.0)

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        # The mover pushes the rover in the step of the contact.
        self._speed = in_rows(tensordict).get("outcome").get("linear_velocity")
        return super()._step(tensordict, next_tensordict)


class TotalReward(Transform):
    """Writes the sum of all reward components to ``reward``. Append it after the components."""

    reads_observation = False

    def transform_output_spec(self, output_spec: Composite) -> Composite:
        # The environment already has ``reward``.
        return output_spec

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        components = next_tensordict.get("reward_components", None)
        if components is None:
            raise RuntimeError("TotalReward found no reward components; append it after at least one RewardComponent")
        next_tensordict.set("reward", torch.cat(list(components.values()), -1).sum(-1, keepdim=True))
        return next_tensordict


def contract_reward(config: RewardConfig | None = None) -> list[Transform]:
    """Returns the components of the contract's reward, without :class:`TotalReward`.

    Components that are not a part of the contract follow if their penalty is not 0.

    Example:
        >>> [component.name for component in contract_reward()]
        ['goal', 'progress', 'velocity', 'turn', 'collision', 'stuck', 'general', 'out_of_bounds']
    """
    config = config or RewardConfig()
    components: list[Transform] = [ConfiguredComponent(config, name) for name in CONTRACT]
    if config.clearance_penalty:
        components.append(ConfiguredComponent(config, "clearance"))
    if config.action_rate_penalty:
        components.append(ActionRatePenalty(config))
    if config.mover_contact_penalty or config.struck_penalty:
        components.append(MoverContactPenalty(config))
    if config.intrusion_penalty or config.haste_penalty or config.risk_penalty:
        components.append(ConfiguredComponent(config, "mover_proximity"))
    return components


def pays_for_goals(components: Sequence[Transform]) -> bool:
    """Whether a reward may pay for goals. That of the bare task and a component of one's own without ``phases`` do."""

    def pays(component: Transform) -> bool:
        phases, own = getattr(component, "phases", ()), not isinstance(component, ConfiguredComponent)
        return StepEvent.GOAL in phases if phases else own

    return not components or any(map(pays, components))


_REGISTRY = Registry("reward", {"contract": contract_reward, "task": list})


def register_reward(name: str, reward: Any) -> None:
    """Registers a reward under a new name, for ``make_env``, ``EnvConfig`` and ``--reward``.

    It is a :class:`RewardComponent` class or object, a list of them, a :class:`RewardConfig`, a function without
    arguments that returns one of these, or ``"module:attribute"`` of any of these. Raises ``ValueError`` if the name is
    taken, or has other characters than letters, digits, ``_``, ``-`` and ``.``.
    """
    _REGISTRY.register(name, reward)


def reward_names() -> list[str]:
    return _REGISTRY.names()


def reward_components(reward: Any, contract: RewardConfig | None = None) -> list[Transform]:
    """Creates the components of a reward. The list is empty for the reward of the bare task.

    ``reward`` is a name in :func:`reward_names`, ``"module:attribute"`` of your own reward, a :class:`RewardConfig`, a
    :class:`RewardComponent`, or a sequence of these, which are added up; else, this raises ``ValueError``. ``contract``
    are the parameters of the contract's reward.

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
