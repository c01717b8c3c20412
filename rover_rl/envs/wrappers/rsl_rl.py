"""``VecEnv`` of rsl_rl for a batch of rovers."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Composite
from torchrl.envs import EnvBase

from rover_rl.envs.wrappers.learning_options import LearningOptions, Reward, base_env, steps_per_action, with_options

if TYPE_CHECKING:
    from typing_extensions import Unpack

try:
    from rsl_rl.env import VecEnv
except ImportError as error:
    raise ImportError("rover_rl.envs.wrappers.rsl_rl needs rsl_rl 3 or later: pip install rsl-rl-lib") from error


class RslRlVecEnv(VecEnv):
    """Wraps a :class:`rover_rl.RoverEnv` of any number of rovers as a ``VecEnv`` of rsl_rl, on any device.

    Each entry of the observation is a group: with ``scale_observations``, set ``obs_groups`` of the runner to
    ``{"actor": ["observation"], "critic": ["observation"]}``. A row whose episode ends is reset in the same step.

    Args:
        env: ``RoverEnv``, or a ``TransformedEnv`` of one, for example from :func:`rover_rl.make_env`.
        reward: see :class:`~rover_rl.envs.wrappers.gym.GymWrapper`.
        cfg: configuration that rsl_rl logs.
        **options: see :class:`~rover_rl.envs.wrappers.learning_options.LearningOptions`.

    Attributes:
        env, base_env: environment with its reward, and the ``RoverEnv`` under the transforms.
        num_envs, num_actions: number of rovers, and of entries of an action.
        device: device of all tensors.
        max_episode_length: number of actions after which an episode is truncated.
        episode_length_buf: number of actions in the episode of each row, int64 ``[N]``. The runner sets it to random
            numbers, so that episodes do not end at the same time.

    Example:
        >>> envs = RslRlVecEnv(rover_rl.RoverEnv(num_envs=64, backend="warp"), action_repeat=4, scale_observations=True)
        >>> envs.get_observations()["observation"].shape
        torch.Size([64, 41])
    """

    def __init__(
        self,
        env: EnvBase,
        *,
        reward: Reward | None = None,
        cfg: dict[str, Any] | None = None,
        **options: Unpack[LearningOptions],
    ) -> None:
        if len(env.batch_size) != 1:
            raise ValueError(f"rsl_rl needs a batch of rovers, got the batch size {[*env.batch_size]}; give num_envs")
        self.env, _ = with_options(env, reward, options)
        self.base_env = base_env(env)
        self.num_envs = self.base_env.num_envs
        self.num_actions = self.env.action_spec.shape[-1]
        self.device = self.env.device or torch.device("cpu")
        self.max_episode_length = math.ceil(self.base_env.length / steps_per_action(self.env))
        self.cfg = {} if cfg is None else cfg
        spec = self.env.observation_spec
        leaves = [key for key in spec if not isinstance(spec[key], Composite)]
        self._groups = [key for key in leaves if spec[key].dtype.is_floating_point]
        self.reset()

    def reset(self) -> tuple[TensorDict, dict[str, Any]]:
        """Begins the next episode in every row. Returns the observations and no extras."""
        self._root: TensorDictBase = self.env.reset()
        self.episode_length_buf = torch.zeros(self.num_envs, dtype=torch.int64, device=self.device)
        self._reached = torch.zeros_like(self.episode_length_buf, dtype=torch.bool)
        return self.get_observations(), {}

    def get_observations(self) -> TensorDict:
        """Returns the current observations, ``[N, k]`` per entry."""
        groups = {key: self._root.get(key).clone() for key in self._groups}
        return TensorDict(groups, [self.num_envs], device=self.device)

    def step(self, actions: Tensor) -> tuple[TensorDict, Tensor, Tensor, dict[str, Any]]:
        """Takes one step in every row with actions ``[N, 2]``, which are clipped to their bounds.

        Returns observations after the reset of the rows that ended, rewards ``[N]``, dones ``[N]`` (bool), and extras:
        ``time_outs`` (bool ``[N]``) and, in ``log``, the share of the ended episodes that reached a goal.
        """
        result = self.env.step(self._root.set("action", actions))
        after = result.get("next")
        self.episode_length_buf = self.episode_length_buf + 1
        terminated = after.get("terminated").squeeze(-1)
        timed_out = after.get("truncated").squeeze(-1) | (self.episode_length_buf >= self.max_episode_length)
        done = terminated | timed_out
        reward = after.get("reward").squeeze(-1).clone()
        self._reached = self._reached | after.get(("outcome", "goal_reached")).squeeze(-1)
        self._root = self.env.step_mdp(result)
        extras: dict[str, Any] = {"time_outs": timed_out & ~terminated}
        if done.any():
            extras["log"] = {"/success": self._reached[done].float().mean()}
            self._root = self.env.reset(self._root.set("_reset", done[:, None]))
            self.episode_length_buf = self.episode_length_buf.masked_fill(done, 0)
            self._reached = self._reached & ~done
        return self.get_observations(), reward, done, extras

    def close(self) -> None:
        """Releases the simulator. Idempotent."""
        self.env.close()
