"""Stable-Baselines3 ``VecEnv`` of a batch of rovers."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from torchrl.envs import EnvBase

from rover_rl.envs.wrappers.numpy_batch import NumpyBatch, Observation, row_of

try:
    from stable_baselines3.common.vec_env import VecEnv
except ImportError as error:
    raise ImportError('rover_rl.envs.sb3 needs Stable-Baselines3: pip install "rover_rl[sb3]"') from error


class SB3VecEnv(VecEnv):
    """Wraps a :class:`rover_rl.RoverEnv` of any number of rovers as a ``VecEnv``, which is stepped as one batch.

    A row whose episode ends is reset in the same step. Its info then contains ``terminal_observation``,
    ``TimeLimit.truncated`` and the ``info`` of :class:`~rover_rl.GymWrapper`. The infos of the other rows are empty.

    ``env`` is a ``RoverEnv`` or a ``TransformedEnv`` of one (``base_env``), and the options are those of
    :class:`~rover_rl.GymWrapper`. The default of ``time_limit`` is ``"truncated"``, so that algorithms bootstrap the
    value at the end of an episode's length. Attributes and methods are those of the ``RoverEnv``, for all rows.

    Example:
        >>> import rover_rl
        >>> from stable_baselines3 import PPO
        >>> envs = SB3VecEnv(rover_rl.RoverEnv(world_n="maze", num_envs=8))
        >>> model = PPO("MultiInputPolicy", envs, n_steps=64)
    """

    metadata: dict[str, Any]

    def __init__(self, env: EnvBase, **options: Any) -> None:
        options.setdefault("time_limit", "truncated")
        self._batch = NumpyBatch(env, **options)
        self.base_env = self._batch.base_env
        self._actions: np.ndarray | None = None
        super().__init__(self._batch.num_envs, self._batch.observation_space, self._batch.action_space)
        self.metadata["render_fps"] = self._batch.frames_per_second

    def reset(self) -> Observation:
        """Begins the next episode in every row, with the values from ``seed()`` and ``set_options()``.

        The options of a row are ``"start"`` (x, y in m, yaw in rad) and ``"goal"`` (x, y in m), both optional. All rows
        must have the same options.
        """
        names = [sorted(options) for options in self._options]
        if any(each != names[0] for each in names):
            raise ValueError(f"every row must have the same options, got {names}")
        options = {key: [options[key] for options in self._options] for key in names[0]}
        observation = self._batch.reset(seed=self._seeds[0], options=options)
        self.reset_infos = [{} for _ in range(self.num_envs)]
        self._reset_seeds()
        self._reset_options()
        return observation

    def step_async(self, actions: np.ndarray) -> None:
        self._actions = actions

    def step_wait(self) -> tuple[Observation, NDArray[np.float32], NDArray[np.bool_], list[dict[str, Any]]]:
        if self._actions is None:
            raise RuntimeError("step_wait() needs actions; call step_async() first")
        step = self._batch.step(self._actions)
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for row in np.flatnonzero(step.ended).tolist():
            infos[row] = {key: value[row].item() for key, value in step.info.items()}
            infos[row]["terminal_observation"] = row_of(step.observation, row)
            # As in SB3, termination has priority over truncation. Otherwise the value would be bootstrapped.
            infos[row]["TimeLimit.truncated"] = bool(step.truncated[row] and not step.terminated[row])
        observation = self._batch.reset(step.ended) if step.ended.any() else step.observation
        return observation, step.reward.astype(np.float32), step.ended, infos

    def close(self) -> None:
        self._batch.env.close()

    def get_images(self) -> list[NDArray[np.uint8]]:
        return [self._batch.picture(row) for row in range(self.num_envs)]

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        owner = self._batch if attr_name == "render_mode" else self.base_env
        return [getattr(owner, attr_name) for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        self._require_all(indices)
        setattr(self.base_env, attr_name, value)

    def env_method(self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any) -> list[Any]:
        self._require_all(indices)
        return [getattr(self.base_env, method_name)(*method_args, **method_kwargs)] * self.num_envs

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        """Returns ``False`` for each row, because Gymnasium's wrappers do not apply to a batch."""
        return [False for _ in self._get_indices(indices)]

    def _require_all(self, indices: Any) -> None:
        if sorted(self._get_indices(indices)) != list(range(self.num_envs)):
            raise ValueError(f"the rows share one RoverEnv: leave out indices, got {indices}")
