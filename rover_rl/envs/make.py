"""make_env: the environment with a reward."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from torchrl.envs import Compose, EnvBase, TransformedEnv

from rover_rl.envs.config import EnvConfig, RewardLike
from rover_rl.envs.rewards import TotalReward, reward_components
from rover_rl.envs.rover import RoverEnv


class RewardedEnv(TransformedEnv):
    """A :class:`RoverEnv` with its reward: what :func:`make_env` returns.

    ``TransformedEnv(env, transform)`` nests around it, as around any base environment: TorchRL merges nested
    ``TransformedEnv`` objects into one, but no subclasses, so ``transform[0]`` is the first transform that the user
    added. ``env.append_transform(transform)`` appends to the transforms of the reward.

    Attributes:
        config: the environment's description, reward included.

    Example:
        >>> env = TransformedEnv(make_env(world_n="maze"), StepCounter())
        >>> type(env.base_env).__name__, type(env.base_env.base_env).__name__
        ('RewardedEnv', 'RoverEnv')
        >>> env.transform
        StepCounter(keys=[])
    """

    config: EnvConfig
    # Without this, TorchRL refuses random actions where a transform nested around this environment changes the action.
    rand_action = EnvBase.rand_action


def make_env(*args: Any, reward: RewardLike = "contract", **kwargs: Any) -> EnvBase:
    """A :class:`RoverEnv` with the contract's reward, or yours.

    Args:
        *args: an :class:`~rover_rl.envs.config.EnvConfig`, alone; or arguments of :class:`RoverEnv`.
        reward: ``"contract"``; ``"task"`` for the bare 1 a goal; the name or ``module:attribute`` of a reward of your
            own; a :class:`~rover_rl.envs.config.RewardConfig` with other numbers; a
            :class:`~rover_rl.envs.rewards.RewardComponent`; or a sequence of these, for example
            ``[*contract_reward(), TiltPenalty()]``.
        **kwargs: arguments of :class:`RoverEnv`.

    Raises:
        ValueError: for another reward, and as :class:`RoverEnv`.
        TypeError: for other arguments beside an ``EnvConfig``.

    Example:
        >>> env = make_env(world_n="maze", num_envs=4, seed=0)
        >>> env.rollout(5)["next", "reward_components", "progress"].shape
        torch.Size([4, 5, 1])
    """
    if args and isinstance(args[0], EnvConfig):
        if len(args) > 1 or kwargs or reward != "contract":
            raise TypeError("make_env takes an EnvConfig alone; use dataclasses.replace(config, ...) to change it")
        return _make(args[0])
    # An unknown reward is an error before a simulator is built.
    reward_components(reward)
    return add_reward(RoverEnv(*args, **kwargs), reward)


def _make(config: EnvConfig) -> EnvBase:
    reward_components(config.reward, config.contract_reward)
    return add_reward(RoverEnv(**config.arguments()), config.reward, config)


def add_reward(env: EnvBase, reward: RewardLike = "contract", config: EnvConfig | None = None) -> EnvBase:
    """Adds a reward to an environment; see :func:`make_env`.

    Args:
        env: a :class:`RoverEnv`.
        reward: the reward.
        config: the environment's description; ``None``: its own, with the reward.
    """
    config = config or replace(env.config, reward=reward)
    components = reward_components(config.reward, config.contract_reward)
    if not components:
        return env
    rewarded = RewardedEnv(env, Compose(*components, TotalReward()))
    rewarded.config = config
    return rewarded
