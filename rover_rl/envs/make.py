"""make_env: the environment with a reward."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from torchrl.envs import Compose, EnvBase, TransformedEnv
from torchrl.envs.transforms import Transform

from rover_rl.envs.rewards import RewardComponent, RewardConfig, TotalReward, contract_reward
from rover_rl.envs.rover import RoverEnv


class RewardedEnv(TransformedEnv):
    """A :class:`RoverEnv` with its reward: what :func:`make_env` returns.

    ``TransformedEnv(env, transform)`` nests around it, as around any base environment: TorchRL merges nested
    ``TransformedEnv`` objects into one, but no subclasses, so ``transform[0]`` is the first transform that the user
    added. ``env.append_transform(transform)`` appends to the transforms of the reward.

    Example:
        >>> env = TransformedEnv(make_env(world_n="maze"), StepCounter())
        >>> type(env.base_env).__name__, type(env.base_env.base_env).__name__
        ('RewardedEnv', 'RoverEnv')
        >>> env.transform
        StepCounter(keys=[])
    """

    # Without this, TorchRL refuses random actions where a transform nested around this environment changes the action.
    rand_action = EnvBase.rand_action


def make_env(*args: Any, reward: str | RewardConfig | Sequence[RewardComponent] = "contract", **kwargs: Any) -> EnvBase:
    """A :class:`RoverEnv` with the contract's reward, or yours.

    Args:
        *args: of :class:`RoverEnv`.
        reward: ``"contract"``; ``"task"`` for the bare 1 a goal; a :class:`RewardConfig` with other numbers; or the
            components themselves, for example ``[*contract_reward(), TiltPenalty()]``.
        **kwargs: of :class:`RoverEnv`.

    Raises:
        ValueError: for another reward, and as :class:`RoverEnv`.

    Example:
        >>> env = make_env(world_n="maze", num_envs=4, seed=0)
        >>> env.rollout(5)["next", "reward_components", "progress"].shape
        torch.Size([4, 5, 1])
    """
    components = _components(reward)
    return add_reward(RoverEnv(*args, **kwargs), components)


def add_reward(env: EnvBase, reward: str | RewardConfig | Sequence[RewardComponent] = "contract") -> EnvBase:
    """``env`` with a reward on top; see :func:`make_env`."""
    components = _components(reward)
    return RewardedEnv(env, Compose(*components, TotalReward())) if components else env


def _components(reward: str | RewardConfig | Sequence[RewardComponent]) -> list[Transform]:
    if isinstance(reward, RewardConfig):
        return contract_reward(reward)
    if not isinstance(reward, str):
        return list(reward)
    if reward not in ("contract", "task"):
        raise ValueError(
            f"unknown reward {reward!r}; use 'contract', 'task', a RewardConfig or a list of RewardComponents"
        )
    return contract_reward() if reward == "contract" else []
