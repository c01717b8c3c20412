"""The environment driven with numpy arrays: what the Gymnasium and Stable-Baselines3 classes share."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias, get_args

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import ArrayLike, NDArray
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, TensorSpec
from torchrl.envs import EnvBase, TransformedEnv

from rover_rl.checks import check_seed
from rover_rl.envs.make import add_reward
from rover_rl.envs.rewards import RewardComponent, RewardConfig
from rover_rl.envs.rover import RoverEnv
from rover_rl.envs.rows import in_rows
from rover_rl.envs.task import EVENTS
from rover_rl.sims.base import View

Observation: TypeAlias = dict[str, NDArray[np.float32]]
Mask: TypeAlias = NDArray[np.bool_]
Reward: TypeAlias = str | RewardConfig | Sequence[RewardComponent]
TimeLimit: TypeAlias = Literal["terminated", "truncated"]

KEYS = ("lidar", "pose", "imu", "target", "velocities")
"""The contract's observation."""


@dataclass(frozen=True)
class Step:
    """What a step of the batch brought; every array is the receiver's own.

    Attributes:
        observation: after the step, each entry ``[N, k]``.
        reward: float64 ``[N]``.
        terminated, truncated: bool ``[N]``.
        info: ``steps``, ``total_steps``, ``reward``, ``goals``, ``is_success`` and a bool an event,
            ``[N]`` each.
    """

    observation: Observation
    reward: NDArray[np.float64]
    terminated: Mask
    truncated: Mask
    info: dict[str, NDArray[Any]]

    @property
    def ended(self) -> Mask:
        """Rows whose episode ended in this step, bool ``[N]``."""
        return self.terminated | self.truncated


class NumpyBatch:
    """Steps, resets and pictures of a :class:`~rover_rl.envs.RoverEnv` in numpy.

    Args:
        env: a ``RoverEnv``, or a ``TransformedEnv`` made from one, which has its reward already.
        reward: for a bare ``RoverEnv``, as in :func:`rover_rl.make_env`; ``None`` is the contract's.
        time_limit: what an episode is that ends by its length.
        render_mode: ``None`` or ``"rgb_array"``.
        camera: from where pictures are taken.

    Attributes:
        env: the environment with its reward.
        base_env: the ``RoverEnv`` in it.
        observation_space, action_space: of one row, as the environment's transforms leave them.
        reward_config: numbers of the contract's reward; ``None`` where the reward is another, or was added
            elsewhere.

    Raises:
        TypeError: if ``env`` is something else.
        ValueError: for a second reward, a missing observation or an unknown option.
    """

    def __init__(
        self,
        env: EnvBase,
        *,
        reward: Reward | None = None,
        time_limit: TimeLimit = "terminated",
        render_mode: str | None = None,
        camera: View = "chase",
    ) -> None:
        _require_one_of("time_limit", time_limit, get_args(TimeLimit))
        _require_one_of("render_mode", render_mode, (None, "rgb_array"))
        _require_one_of("camera", camera, get_args(View))
        self.base_env = base_env(env)
        self.env, self.reward_config = _with_reward(env, reward)
        self.num_envs: int = self.base_env.num_envs
        self.observation_space = _observation_space(self.env)
        self.action_space = _box(self.env.action_spec_unbatched)
        self.render_mode = render_mode
        self._camera = camera
        self._time_limit = time_limit
        self._root: TensorDictBase | None = None
        self._goals = np.zeros(self.num_envs, np.int64)
        self._seeded_at = np.zeros(self.num_envs, np.int64)

    @property
    def total_steps(self) -> NDArray[np.int64]:
        """Steps of each row since it was seeded last, ``[N]``: a seed reproduces them too."""
        return _flat(self._started("total_steps")["outcome", "total_steps"]) - self._seeded_at

    def observation(self) -> Observation:
        """The present observation, each entry ``[N, k]``."""
        rows = in_rows(self._started("the observation"))
        return {key: rows.get(key).numpy(force=True).copy() for key in KEYS}

    def reset(
        self,
        rows: Mask | None = None,
        *,
        seed: int | None = None,
        options: Mapping[str, ArrayLike] | None = None,
    ) -> Observation:
        """Begins the next episode and returns the observation of every row.

        Args:
            rows: bool ``[N]``, the rows to reset; ``None``: all.
            seed: of the first row, the others counting on; ``None`` goes on with the seeds at hand.
            options: may hold ``"start"`` (``[N, 3]``: x, y in m, yaw in rad) and ``"goal"`` (``[N, 2]``, m).

        Raises:
            ValueError: for another option, one of the wrong shape, or a seed for some rows only.
            RuntimeError: on a closed environment.
        """
        self._require_open("reset")
        given = {key: np.asarray(value, np.float32) for key, value in (options or {}).items()}
        if unknown := given.keys() - {"start", "goal"}:
            raise ValueError(f"unknown reset options {sorted(unknown)}; use 'start' and 'goal'")
        rows = np.ones(self.num_envs, np.bool_) if rows is None else rows
        if seed is not None:
            if not rows.all():
                raise ValueError("a seed is for all rows: give it to a reset of all of them")
            self.base_env.set_seed(check_seed(seed, self.num_envs))
        root = None if rows.all() else self._started("a reset of some rows").set("_reset", self._mask(rows))
        if not self.env.batch_size:
            given = {key: value[0] for key, value in given.items()}
        self._root = self.env.reset(root, **given)
        self._goals[rows] = 0
        if seed is not None:
            self._seeded_at += self.total_steps
        return self.observation()

    def step(self, actions: ArrayLike, rows: Mask | None = None) -> Step:
        """Steps the rows of ``rows`` (bool ``[N]``; ``None``: all); for the others no time passes.

        Args:
            actions: ``[N, 2]``: forward speed (m/s) and heading offset (rad), if no transform says otherwise.
            rows: the other rows' actions are ignored, their reward is 0 and nothing ends them.
        """
        self._require_open("step")
        actions = np.array(actions, np.float32)
        expected = (self.num_envs, *self.action_space.shape)
        if actions.shape != expected:
            raise ValueError(f"actions must have shape {expected}, got {actions.shape}")
        root = self._started("step()")
        if rows is not None:
            actions[~rows] = 0.0
            root.set("_step", self._mask(rows))
        action = torch.as_tensor(actions, device=self.env.device)
        root.set("action", action.reshape(self.env.action_spec.shape))
        result = self.env.step(root)
        # Else the next step would hold these rows too.
        result.pop("_step", None)
        self._root = self.env.step_mdp(result)
        return self._unpack(result.get("next"), rows)

    def picture(self, row: int) -> NDArray[np.uint8]:
        """A picture of one rover: ``[height, width, 3]``."""
        self._require_open("render")
        return self.base_env.render(row, self._camera).numpy(force=True)

    def _unpack(self, result: TensorDictBase, rows: Mask | None) -> Step:
        active = np.ones(self.num_envs, np.bool_) if rows is None else rows
        outcome = result.get("outcome")
        reward = np.where(active, _flat(result.get("reward")).astype(np.float64), 0.0)
        events = {event: _flat(outcome.get(event)) & active for event in EVENTS}
        self._goals += events["goal_reached"]
        terminated = _flat(result.get("terminated")) & active
        truncated = _flat(result.get("truncated")) & active
        if self._time_limit == "terminated":
            terminated, truncated = terminated | truncated, np.zeros_like(truncated)
        info: dict[str, NDArray[Any]] = {
            "steps": _flat(outcome.get("steps")),
            "total_steps": self.total_steps,
            "reward": reward.copy(),
            "goals": self._goals.copy(),
            "is_success": self._goals > 0,
            **events,
        }
        return Step(self.observation(), reward, terminated, truncated, info)

    def _started(self, what: str) -> TensorDictBase:
        if self._root is None:
            raise RuntimeError(f"{what} needs a running episode; call reset() first")
        return self._root

    def _require_open(self, what: str) -> None:
        if self.base_env.is_closed:
            raise RuntimeError(f"{what}() was called on a closed environment; make a new one")

    def _mask(self, rows: Mask) -> Tensor:
        return torch.tensor(rows, device=self.env.device).reshape(*self.env.batch_size, 1)


def base_env(env: EnvBase) -> RoverEnv:
    """The :class:`RoverEnv` under the transforms of ``env``.

    Raises:
        TypeError: if there is none.
    """
    inner = env
    while isinstance(inner, TransformedEnv):
        inner = inner.base_env
    if not isinstance(inner, RoverEnv):
        raise TypeError(f"a rover_rl.RoverEnv, or a TransformedEnv of one, is needed; got {type(env).__name__}")
    return inner


def frames_per_second(env: EnvBase) -> int:
    """Frame rate of a video with one picture per step."""
    return round(1 / base_env(env).control_dt)


def row_of(observation: Observation, row: int) -> Observation:
    """One row of an observation, in arrays of its own."""
    return {key: value[row].copy() for key, value in observation.items()}


def _with_reward(env: EnvBase, reward: Reward | None) -> tuple[EnvBase, RewardConfig | None]:
    if isinstance(env, TransformedEnv):
        if reward is not None:
            raise ValueError("a TransformedEnv has its reward already: leave out reward=, or give the bare RoverEnv")
        return env, None
    reward = "contract" if reward is None else reward
    config = RewardConfig() if isinstance(reward, str) and reward == "contract" else reward
    return add_reward(env, reward), config if isinstance(config, RewardConfig) else None


def _observation_space(env: EnvBase) -> spaces.Dict:
    missing = [key for key in KEYS if key not in env.observation_spec]
    if missing:
        raise ValueError(f"the observation lacks {missing}, which a transform has removed; {list(KEYS)} are needed")
    return spaces.Dict({key: _box(env.observation_spec_unbatched[key]) for key in KEYS})


def _box(spec: TensorSpec) -> spaces.Box:
    """The space of one row's spec."""
    if isinstance(spec, Bounded):
        low, high = spec.space.low.numpy(force=True), spec.space.high.numpy(force=True)
        return spaces.Box(low, high, dtype=np.float32)
    return spaces.Box(-np.inf, np.inf, tuple(spec.shape), np.float32)


def _flat(column: Tensor) -> NDArray[Any]:
    """``[N]`` of ``[N, 1]``, or of an unbatched environment's ``[1]``, in memory of its own."""
    return column.reshape(-1).numpy(force=True).copy()


def _require_one_of(name: str, value: object, allowed: tuple[object, ...]) -> None:
    if value not in allowed:
        raise ValueError(f"{name} must be one of {list(allowed)}, got {value!r}")
