"""``make_env``: builds a :class:`RoverEnv` with its action, terminations and reward."""

from __future__ import annotations

from typing import Any

from torchrl.envs import Compose, EnvBase, TransformedEnv

from rover_rl.envs.actions import action_transforms, find_action
from rover_rl.envs.config import EnvConfig, env_signature
from rover_rl.envs.events import events
from rover_rl.envs.rewards import TotalReward, reward_components
from rover_rl.envs.rover import RoverEnv
from rover_rl.envs.terminations import terminations


class RewardedEnv(TransformedEnv):
    """:class:`RoverEnv` with action, terminations and reward, as :func:`make_env` returns it, and its ``config``.

    ``TransformedEnv(env, transform)`` nests around it as around any base environment. TorchRL merges nested
    ``TransformedEnv`` objects but not their subclasses, so ``transform[0]`` is the first transform that the user added.
    ``env.append_transform(transform)`` appends to the transforms of the reward.
    """

    config: EnvConfig
    # Otherwise TorchRL does not allow random actions if a transform around this environment changes the action.
    rand_action = EnvBase.rand_action


def make_env(*args: Any, **settings: Any) -> EnvBase:
    """Creates a :class:`RoverEnv` with action, terminations and reward, by default the contract's.

    It takes an :class:`~rover_rl.envs.config.EnvConfig`, or its settings and arguments of the contract:
    ``lidar=LidarConfig(points=16)`` or ``lidar_points=16``. ``task="mazes"`` takes the settings of a task
    (``rover-rl tasks``), which other settings override. The ``reward`` is ``"contract"``; ``"task"`` (1 per goal);
    name or ``"module:attribute"`` of your own reward; a :class:`~rover_rl.envs.config.RewardConfig`; a
    :class:`~rover_rl.envs.rewards.RewardComponent`; or a sequence of these: ``[*contract_reward(), TiltPenalty()]``.
    An unknown reward raises ``ValueError``.

    Example:
        >>> env = make_env(world="maze", num_envs=4, seed=0, lidar=LidarConfig(points=16))
        >>> env.rollout(5)["next", "reward_components", "progress"].shape
        torch.Size([4, 5, 1])
    """
    config = EnvConfig.of(*args, **settings)
    check_terms(config)
    return add_terms(RoverEnv(config), config)


make_env.__signature__ = env_signature()  # type: ignore[attr-defined]


def check_terms(config: EnvConfig) -> None:
    """Raises an error for an unknown action, termination, event or reward, before a simulator is built."""
    find_action(config.action.kind)
    terminations(config.terminate)
    events(config.events)
    reward_components(config.reward, config.contract_reward)


def add_terms(env: RoverEnv, config: EnvConfig | None = None) -> EnvBase:
    """Adds action, terminations and reward to a :class:`RoverEnv` as transforms, in this order.

    They are those of ``config``, which describes the result, by default those of the environment, whose reward is the
    bare task's.
    """
    config = config or env.config
    rewards = reward_components(config.reward, config.contract_reward)
    transforms = [*action_transforms(config, env.fleet), *terminations(config.terminate), *rewards]
    if not transforms:
        return env
    rewarded = RewardedEnv(env, Compose(*transforms, *([TotalReward()] if rewards else [])))
    rewarded.config = config
    return rewarded
