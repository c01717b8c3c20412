"""The batch as one Stable-Baselines3 ``VecEnv``."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from torchrl.envs import EnvBase

from rover_rl.envs.rover import RoverEnv
from rover_rl.envs.wrappers.numpy_batch import NumpyBatch, Observation, Reward, TimeLimit, frames_per_second, row_of
from rover_rl.sims.base import View

try:
    from stable_baselines3.common.vec_env import VecEnv
except ImportError as error:
    raise ImportError('rover_rl.envs.wrappers.sb3 needs Stable-Baselines3: pip install "rover_rl[sb3]"') from error


class SB3VecEnv(VecEnv):
    """A :class:`rover_rl.RoverEnv` of any number of rovers as a ``VecEnv``, stepped as one batch.

    A row that ends begins anew in the same step. Its info then holds ``terminal_observation``,
    ``TimeLimit.truncated`` and what :class:`~rover_rl.envs.wrappers.gym.GymWrapper` tells of a step; the infos of the
    other rows are empty.

    Args:
        env: a ``RoverEnv``, or a ``TransformedEnv`` made from one (as by :func:`rover_rl.make_env`).
        reward, render_mode, camera: see :class:`~rover_rl.envs.wrappers.gym.GymWrapper`.
        time_limit: ``"truncated"``, so that values are bootstrapped at the end of an episode's length; or
            ``"terminated"``, the contract's reading.

    Example:
        >>> import rover_rl
        >>> from stable_baselines3 import PPO
        >>> envs = SB3VecEnv(rover_rl.RoverEnv(world_n="maze", num_envs=8))
        >>> model = PPO("MultiInputPolicy", envs, n_steps=64)
    """

    metadata: dict[str, Any]

    def __init__(
        self,
        env: EnvBase,
        *,
        reward: Reward | None = None,
        time_limit: TimeLimit = "truncated",
        render_mode: str | None = None,
        camera: View = "chase",
    ) -> None:
        self._batch = NumpyBatch(env, reward=reward, time_limit=time_limit, render_mode=render_mode, camera=camera)
        self._actions: np.ndarray | None = None
        super().__init__(self._batch.num_envs, self._batch.observation_space, self._batch.action_space)
        self.metadata["render_fps"] = frames_per_second(env)

    @property
    def base_env(self) -> RoverEnv:
        """The ``RoverEnv`` under the transforms."""
        return self._batch.base_env

    def reset(self) -> Observation:
        """Begins the next episode in every row, with what ``seed()`` and ``set_options()`` have set.

        A row's options may hold ``"start"`` (x, y in m, yaw in rad) and ``"goal"`` (x, y in m); every row has
        the same ones.
        """
        keys = self._options[0].keys()
        if any(options.keys() != keys for options in self._options):
            names = [sorted(options) for options in self._options]
            raise ValueError(f"every row must have the same options, got {names}")
        options = {key: [options[key] for options in self._options] for key in keys}
        observation = self._batch.reset(seed=self._seeds[0], options=options)
        self.reset_infos = [{} for _ in range(self.num_envs)]
        self._reset_seeds()
        self._reset_options()
        return observation

    def step_async(self, actions: np.ndarray) -> None:
        """Takes the actions ``[N, 2]`` of the next :meth:`step_wait`."""
        self._actions = actions

    def step_wait(self) -> tuple[Observation, NDArray[np.float32], NDArray[np.bool_], list[dict[str, Any]]]:
        """One step of 0.05 s: observations, rewards, dones and infos."""
        if self._actions is None:
            raise RuntimeError("step_wait() needs actions; call step_async() first")
        step = self._batch.step(self._actions)
        observation, ended = step.observation, step.ended
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        if ended.any():
            for row in np.flatnonzero(ended).tolist():
                infos[row] = {key: value[row].item() for key, value in step.info.items()}
                infos[row]["terminal_observation"] = row_of(observation, row)
                # As in SB3: a real ending goes before a time limit, or its value would be bootstrapped.
                infos[row]["TimeLimit.truncated"] = bool(step.truncated[row] and not step.terminated[row])
            observation = self._batch.reset(ended)
        return observation, step.reward.astype(np.float32), ended, infos

    def close(self) -> None:
        """Lets go of the simulator; may be called again."""
        self._batch.env.close()

    def get_images(self) -> list[NDArray[np.uint8]]:
        """A picture ``[480, 640, 3]`` of every rover."""
        return [self._batch.picture(row) for row in range(self.num_envs)]

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """An attribute of the batched ``RoverEnv``, once for each row asked for."""
        owner = self._batch if attr_name == "render_mode" else self.base_env
        return [getattr(owner, attr_name) for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Sets an attribute of the batched ``RoverEnv``, which is that of all rows."""
        self._require_all(indices)
        setattr(self.base_env, attr_name, value)

    def env_method(self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any) -> list[Any]:
        """Calls a method of the batched ``RoverEnv`` once; its answer, once for each row."""
        self._require_all(indices)
        return [getattr(self.base_env, method_name)(*method_args, **method_kwargs)] * self.num_envs

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        """False for each row: Gymnasium's wrappers do not apply to a batch."""
        return [False for _ in self._get_indices(indices)]

    def _require_all(self, indices: Any) -> None:
        if sorted(self._get_indices(indices)) != list(range(self.num_envs)):
            raise ValueError(f"the rows share one RoverEnv: leave out indices, got {indices}")
