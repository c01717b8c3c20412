"""Gymnasium vector environment of a batch of rovers."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import ArrayLike, NDArray
from torchrl.envs import EnvBase

from rover_rl.checks import check_seed
from rover_rl.envs.rover import RoverEnv
from rover_rl.envs.wrappers.numpy_batch import Mask, NumpyBatch, Observation, Step, WrapperOptions, pop_options, row_of

if TYPE_CHECKING:
    from typing_extensions import Unpack

VectorStep = tuple[Observation, NDArray[np.float64], Mask, Mask, dict[str, Any]]


class GymVectorWrapper(VectorEnv[Any, Any, Any]):
    """Wraps a :class:`rover_rl.RoverEnv` of any number of rovers as a ``gymnasium.vector.VectorEnv``.

    Row ``i`` is bit-identical to a :class:`~rover_rl.envs.wrappers.gym.GymWrapper` of one rover with seed ``seed + i``.
    ``infos`` contains the entries of its ``info`` as arrays ``[N]``, each with a mask under ``"_" + key``. It does not
    contain ``reward``, because TorchRL's ``GymWrapper`` would use an info of that name instead of the reward.

    Args:
        env: ``RoverEnv``, or a ``TransformedEnv`` of one, for example from :func:`rover_rl.make_env`.
        autoreset_mode: time at which rows whose episode ended are reset, as defined by Gymnasium: in the next step,
            which ignores their action (``NEXT_STEP``); in the same step, with ``final_obs`` and ``final_info`` in
            ``infos`` (``SAME_STEP``); or by ``reset(options={"reset_mask": ...})`` (``DISABLED``).
        **options: options of :class:`~rover_rl.envs.wrappers.gym.GymWrapper`.

    Attributes:
        base_env: the ``RoverEnv`` under the transforms.

    Example:
        >>> import rover_rl
        >>> envs = GymVectorWrapper(rover_rl.RoverEnv(world_n="maze", num_envs=4))
        >>> observations, infos = envs.reset(seed=0)
        >>> observations["lidar"].shape
        (4, 32)
    """

    def __init__(
        self,
        env: EnvBase,
        *,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        **options: Unpack[WrapperOptions],
    ) -> None:
        self.autoreset_mode = AutoresetMode(autoreset_mode)
        self._batch = NumpyBatch(env, **options)
        self.base_env, self.num_envs = self._batch.base_env, self._batch.num_envs
        self.single_observation_space = self._batch.observation_space
        self.single_action_space = self._batch.action_space
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self.render_mode = self._batch.render_mode
        self.metadata = {
            "render_modes": ["rgb_array"],
            "render_fps": self._batch.frames_per_second,
            "autoreset_mode": self.autoreset_mode,
        }
        self._ended = np.zeros(self.num_envs, np.bool_)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begins the next episode in all rows, or in those of a mask.

        Args:
            seed: seed ``s`` of row 0, with ``s + i`` in row ``i``; or the list ``[s, s + 1, ...]``. ``None`` continues
                with the current seeds.
            options: ``"start"`` (``[N, 3]``: x, y in m, yaw in rad), ``"goal"`` (``[N, 2]``, m) and ``"reset_mask"``
                (bool ``[N]``, rows to reset), all optional.

        Raises:
            ValueError: if seeds are out of range or not consecutive, a seed is given for some rows only, or an option
                is unknown or has the wrong shape.
        """
        options = dict(options or {})
        rows = self._reset_mask(options.pop("reset_mask", None))
        first = _first_seed(seed, self.num_envs)
        super().reset(seed=first)
        observation = self._batch.reset(rows, seed=first, options=options)
        self._ended = self._ended & ~rows
        return observation, {}

    def step(self, actions: ArrayLike) -> VectorStep:
        """Takes one step in every row: 0.05 s, or ``action_repeat`` times as long.

        Args:
            actions: forward speed (m/s) and heading offset (rad), ``[N, 2]``. Clipped to the action space.

        Raises:
            ValueError: if the shape is wrong, or values are not finite.
            RuntimeError: if ``autoreset_mode`` is ``DISABLED`` and a row whose episode ended was not reset.
        """
        if self.autoreset_mode is AutoresetMode.NEXT_STEP and self._ended.any():
            return self._step_and_reset_ended(actions)
        if self._ended.any():
            raise RuntimeError(
                f"rows {np.flatnonzero(self._ended).tolist()} have ended; "
                "reset them with reset(options={'reset_mask': ...}) before the next step"
            )
        step = self._batch.step(actions)
        if self.autoreset_mode is AutoresetMode.SAME_STEP and step.ended.any():
            return self._reset_in_same_step(step)
        self._ended = step.ended
        infos = _masked(step.info, np.ones_like(self._ended))
        return step.observation, step.reward, step.terminated, step.truncated, infos

    def render(self) -> tuple[NDArray[np.uint8], ...] | None:
        """Returns an image of every rover, uint8 ``[480, 640, 3]``, or ``None`` if there is no render mode."""
        if self.render_mode is None:
            return None
        return tuple(self._batch.picture(row) for row in range(self.num_envs))

    def close_extras(self, **kwargs: Any) -> None:
        """Releases the simulator."""
        self._batch.env.close()

    def _step_and_reset_ended(self, actions: ArrayLike) -> VectorStep:
        """Steps the running rows, and resets the rows whose episode ended in the previous step."""
        running = ~self._ended
        step = self._batch.step(actions, running)
        # The reset comes after the step, so that the reset rows do not take part in it.
        observation = self._batch.reset(self._ended)
        self._ended = step.ended
        return observation, step.reward, step.terminated, step.truncated, _masked(step.info, running)

    def _reset_in_same_step(self, step: Step) -> VectorStep:
        """Resets the rows whose episode ended in ``step``, and adds their final observations and infos."""
        ended = step.ended
        final = np.full(self.num_envs, None, dtype=object)
        for row in np.flatnonzero(ended).tolist():
            final[row] = row_of(step.observation, row)
        infos = _masked(step.info, ~ended)
        infos.update(final_obs=final, _final_obs=ended, final_info=_masked(step.info, ended), _final_info=ended.copy())
        return self._batch.reset(ended), step.reward, step.terminated, step.truncated, infos

    def _reset_mask(self, mask: Any) -> Mask:
        if mask is None:
            return np.ones(self.num_envs, np.bool_)
        mask = np.asarray(mask)
        if mask.shape != (self.num_envs,) or mask.dtype != np.bool_ or not mask.any():
            raise ValueError(
                f"reset_mask must be {self.num_envs} bools, at least one of them True, "
                f"got {mask.dtype} of shape {mask.shape}: {mask.tolist()}"
            )
        return mask


def make_vector_env(num_envs: int = 1, **kwargs: Any) -> GymVectorWrapper:
    """Entry point of ``gymnasium.make_vec("rover_rl/Rover-v0", vectorization_mode="vector_entry_point")``.

    Args:
        num_envs: number of rovers.
        **kwargs: arguments of :class:`rover_rl.RoverEnv` and of :class:`GymVectorWrapper`, and Gymnasium's
            ``disable_env_checker``, which has no effect on a batch.
    """
    kwargs.pop("disable_env_checker", None)
    options, mode = pop_options(kwargs), kwargs.pop("autoreset_mode", AutoresetMode.NEXT_STEP)
    return GymVectorWrapper(RoverEnv(num_envs=num_envs, **kwargs), autoreset_mode=mode, **options)


def _first_seed(seed: int | Sequence[int | None] | None, num_envs: int) -> int | None:
    """Returns the seed of row 0. The seeds of the rows must be consecutive."""
    if not isinstance(seed, Iterable):
        return None if seed is None else check_seed(seed, num_envs)
    seeds = list(seed)
    if seeds == [None] * num_envs:
        return None
    if len(seeds) == num_envs and None not in seeds:
        first = check_seed(seeds[0], num_envs)
        if seeds == list(range(first, first + num_envs)):
            return first
    raise ValueError(f"seeds must be {num_envs} numbers that count on (s, s + 1, ...), or all None; got {seeds}")


def _masked(info: dict[str, NDArray[Any]], rows: Mask) -> dict[str, Any]:
    """Converts ``info`` to Gymnasium's format: without the reward, 0 outside of ``rows``, and with a mask per entry."""
    infos: dict[str, Any] = {}
    for key, value in info.items():
        if key != "reward" and rows.any():
            infos |= {key: np.where(rows, value, value.dtype.type(0)), f"_{key}": rows.copy()}
    return infos
