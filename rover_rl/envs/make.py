"""``make_env``: builds a :class:`RoverEnv` with a reward."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from torchrl.envs import Compose, EnvBase, TransformedEnv

from rover_rl.envs.config import EnvConfig, RewardLike, env_signature
from rover_rl.envs.rewards import TotalReward, reward_components
from rover_rl.envs.rover import RoverEnv


class RewardedEnv(TransformedEnv):
    """:class:`RoverEnv` with a reward, as returned by :func:`make_env`. Its ``config`` includes the reward.

    ``TransformedEnv(env, transform)`` nests around it as around any base environment. TorchRL merges nested
    ``TransformedEnv`` objects but not their subclasses, so ``transform[0]`` is the first transform that the user added.
    ``env.append_transform(transform)`` appends to the transforms of the reward.
    """

    config: EnvConfig
    # Otherwise TorchRL does not allow random actions if a transform around this environment changes the action.
    rand_action = EnvBase.rand_action


def make_env(*args: Any, **settings: Any) -> EnvBase:
    """Creates a :class:`RoverEnv` with a reward, by default the contract's.

    It takes an :class:`~rover_rl.envs.config.EnvConfig`, or its settings and arguments of the contract:
    ``lidar=LidarConfig(points=16)`` or ``lidar_points=16``. The ``reward`` is ``"contract"``; ``"task"`` (1 per goal);
    name or ``"module:attribute"`` of your own reward; a :class:`~rover_rl.envs.config.RewardConfig`; a
    :class:`~rover_rl.envs.rewards.RewardComponent`; or a sequence of these: ``[*contract_reward(), TiltPenalty()]``.
    An unknown reward raises ``ValueError``.

    Example:
        >>> env = make_env(world="maze", num_envs=4, seed=0, lidar=LidarConfig(points=16))
        >>> env.rollout(5)["next", "reward_components", "progress"].shape
        torch.Size([4, 5, 1])
    """
    config = EnvConfig.of(*args, **settings)
    # Raises an error for an unknown reward before the simulator is built.
    reward_components(config.reward, config.contract_reward)
    return add_reward(RoverEnv(config), config.reward, config)


make_env.__signature__ = env_signature()  # type: ignore[attr-defined]


def add_reward(env: EnvBase, reward: RewardLike = "contract", config: EnvConfig | None = None) -> EnvBase:
    """Adds a reward to a :class:`RoverEnv`: that of ``config``, which describes the result, or ``reward``."""
    config = config or replace(env.config, reward=reward)
    components = reward_components(config.reward, config.contract_reward)
    if not components:
        return env
    rewarded = RewardedEnv(env, Compose(*components, TotalReward()))
    rewarded.config = config
    return rewarded
