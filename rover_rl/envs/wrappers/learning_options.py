"""Options of the Gymnasium, Stable-Baselines3 and rsl_rl classes with which the algorithms of others learn."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TypeAlias, TypedDict

from torchrl.envs import Compose, EnvBase, RewardScaling, TransformedEnv
from torchrl.envs.transforms import Transform

from rover_rl.checks import MAX_NUMBER, check_positive
from rover_rl.envs.encoding import ObservationEncoder
from rover_rl.envs.make import add_reward
from rover_rl.envs.rewards import RewardComponent, RewardConfig
from rover_rl.envs.rover import RoverEnv
from rover_rl.envs.transforms.action_repeat import ActionRepeat
from rover_rl.envs.transforms.encoded_observation import EncodedObservation

Reward: TypeAlias = str | RewardConfig | Sequence[RewardComponent]


class LearningOptions(TypedDict, total=False):
    """Options for the algorithms of other libraries. By default, all of them are off.

    Attributes:
        action_repeat: number of steps of 0.05 s that each action is held for. The reward is their sum. Exploration
            noise at 20 Hz averages out; 4 is a good value.
        reward_scale: factor of the reward, whose components are between -0.03 and 100. 0.05 is a good value.
        scale_observations: whether an observation is one vector of float32 features of about [-1, 1], instead of a
            dictionary in meters and radians: that of ``ObservationEncoder.of``, which leaves out the pose.
    """

    action_repeat: int
    reward_scale: float
    scale_observations: bool


def with_options(env: EnvBase, reward: Reward | None, options: LearningOptions) -> tuple[EnvBase, RewardConfig | None]:
    """Adds the reward, by default the contract's, to a bare environment, and then the transforms of the options.

    Returns the environment, and the parameters of the contract's reward: ``None`` if it was not added here.
    """
    if unknown := options.keys() - LearningOptions.__annotations__:
        raise TypeError(f"unknown options {sorted(unknown)}; use some of {[*LearningOptions.__annotations__]}")
    transforms = learning_transforms(base_env(env), **options)
    if isinstance(env, TransformedEnv):
        if reward is not None:
            raise ValueError("a TransformedEnv has its reward already: leave out reward=, or give the bare RoverEnv")
        return TransformedEnv(env, Compose(*transforms)) if transforms else env, None
    reward = "contract" if reward is None else reward
    config = RewardConfig() if isinstance(reward, str) and reward == "contract" else reward
    env = add_reward(env, reward)
    for transform in transforms:
        env = env.append_transform(transform)
    return env, config if isinstance(config, RewardConfig) else None


def learning_transforms(
    env: RoverEnv, action_repeat: int = 1, reward_scale: float = 1.0, scale_observations: bool = False
) -> list[Transform]:
    """Returns the transforms of :class:`LearningOptions`."""
    check_positive(MAX_NUMBER, reward_scale=reward_scale)
    transforms: list[Transform] = [] if action_repeat == 1 else [ActionRepeat(action_repeat)]
    if reward_scale != 1:
        transforms.append(RewardScaling(loc=0.0, scale=reward_scale))
    if scale_observations:
        transforms.append(EncodedObservation(ObservationEncoder.of(env.config)))
    return transforms


def steps_per_action(env: EnvBase) -> int:
    """Returns the number of steps of 0.05 s that an environment holds each action for."""
    modules = env.transform.modules() if isinstance(env, TransformedEnv) else ()
    return math.prod(module.repeat for module in modules if isinstance(module, ActionRepeat))


def base_env(env: EnvBase) -> RoverEnv:
    """Returns the :class:`RoverEnv` under the transforms of ``env``, or raises ``TypeError`` if there is none."""
    inner = env
    while isinstance(inner, TransformedEnv):
        inner = inner.base_env
    if not isinstance(inner, RoverEnv):
        raise TypeError(f"a rover_rl.RoverEnv, or a TransformedEnv of one, is needed; got {type(env).__name__}")
    return inner
