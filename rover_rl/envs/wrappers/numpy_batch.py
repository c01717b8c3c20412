"""NumPy interface of the environment, shared by the Gymnasium, Stable-Baselines3 and PettingZoo classes."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from inspect import signature
from typing import Any, Literal, NamedTuple, TypeAlias, get_args

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import ArrayLike, NDArray
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, TensorSpec
from torchrl.envs import Compose, EnvBase, RewardScaling, TransformedEnv
from torchrl.envs.transforms import Transform

from rover_rl.checks import MAX_COUNT, MAX_NUMBER, check_count, check_positive, check_seed
from rover_rl.envs.encoding import EncodedObservation, ObservationEncoder
from rover_rl.envs.make import add_terms
from rover_rl.envs.rewards import RewardComponent, RewardConfig
from rover_rl.envs.rover import RoverEnv
from rover_rl.envs.sensors.suite import require_entries
from rover_rl.envs.task import EVENTS
from rover_rl.envs.transforms.action_repeat import ActionRepeat
from rover_rl.sims.base import View
from rover_rl.tensordicts import in_rows, with_torch_defaults

Observation: TypeAlias = Any
"""A dictionary of arrays by entry, or one array if observations are scaled. All arrays are float32."""
Mask: TypeAlias = NDArray[np.bool_]
Reward: TypeAlias = str | RewardConfig | Sequence[RewardComponent]
TimeLimit: TypeAlias = Literal["terminated", "truncated"]


class Step(NamedTuple):
    """Result of a step, copied: observations ``[N, k]`` per entry, the others ``[N]``."""

    observation: Observation
    reward: NDArray[np.float64]
    terminated: Mask
    truncated: Mask
    info: dict[str, NDArray[Any]]

    @property
    def ended(self) -> Mask:
        return self.terminated | self.truncated


class NumpyBatch:
    """Resets, steps and renders a :class:`~rover_rl.RoverEnv` with NumPy arrays.

    Spaces are those of one row, after the transforms. An option out of range raises ``ValueError``.

    Args:
        env: ``RoverEnv``, or a ``TransformedEnv`` of one, for example from :func:`rover_rl.make_env`.
        reward: reward of a ``RoverEnv``: ``"contract"`` (also ``None``), ``"task"``, a ``RewardConfig`` or a list of
            components. A ``TransformedEnv`` already has its reward.
        time_limit: signal at the end of an episode's length: ``"terminated"`` as in the contract (``truncated`` is
            never true), or ``"truncated"`` as in Gymnasium's API.
        render_mode: ``None``, or ``"rgb_array"``: ``render()`` returns an image.
        camera: camera position: behind the rover (``"chase"``) or above it (``"top"``).
        max_episode_steps: number of actions after which an episode is truncated, as by Gymnasium's ``TimeLimit``. The
            environment has a length of its own besides.
        action_repeat: number of steps of 0.05 s that each action is held for. The reward is their sum. Exploration
            noise at 20 Hz averages out; 4 is a good value for the algorithms of other libraries.
        reward_scale: factor of the reward, whose components are between -0.03 and 100. 0.05 is a good value.
        scale_observations: whether an observation is one vector of float32 features of about [-1, 1], instead of a
            dictionary in meters and radians: that of ``ObservationEncoder.of``, which leaves out the pose.
        observation: entries that an observation consists of. ``None``: all, or those of ``ObservationEncoder.of``.
    """

    @with_torch_defaults
    def __init__(
        self,
        env: EnvBase,
        *,
        reward: Reward | None = None,
        time_limit: TimeLimit = "terminated",
        render_mode: str | None = None,
        camera: View = "chase",
        max_episode_steps: int | None = None,
        action_repeat: int = 1,
        reward_scale: float = 1.0,
        scale_observations: bool = False,
        observation: Sequence[str] | None = None,
    ) -> None:
        _require_one_of("time_limit", time_limit, get_args(TimeLimit))
        _require_one_of("render_mode", render_mode, (None, "rgb_array"))
        _require_one_of("camera", camera, get_args(View))
        check_positive(MAX_NUMBER, reward_scale=reward_scale)
        self.base_env = base_env(env)
        transforms: list[Transform] = [] if action_repeat == 1 else [ActionRepeat(action_repeat)]
        if reward_scale != 1:
            transforms.append(RewardScaling(loc=0.0, scale=reward_scale))
        if observation is not None:
            require_entries(observation, self.base_env.config.own_sensors)
        if scale_observations:
            transforms.append(EncodedObservation(ObservationEncoder.of(self.base_env.config, observation)))
        self.reward_config: RewardConfig | None = None
        if isinstance(env, TransformedEnv):
            if reward is not None:
                raise ValueError("a TransformedEnv has its reward already: leave out reward=, or give a bare RoverEnv")
            env = TransformedEnv(env, Compose(*transforms)) if transforms else env
        else:
            reward = "contract" if reward is None else reward
            named = isinstance(reward, str) and reward == "contract"
            config = self.base_env.config.contract_reward if named else reward
            self.reward_config = config if isinstance(config, RewardConfig) else None
            env = add_terms(self.base_env, replace(self.base_env.config, reward=reward))
            for transform in transforms:
                env = env.append_transform(transform)
        self.env, self._flat, self.num_envs = env, scale_observations, self.base_env.num_envs
        self._keys, spec = [*(observation or self.base_env.sensors)], env.observation_spec_unbatched
        self.observation_space: spaces.Space[Any]
        if scale_observations:
            self.observation_space = _box(spec[EncodedObservation.KEY])
        else:
            if missing := [key for key in self._keys if key not in spec]:
                raise ValueError(
                    f"the observation lacks {missing}, for which there is no sensor, or which a transform removed"
                )
            self.observation_space = spaces.Dict({key: _box(spec[key]) for key in self._keys})
        self.action_space = _box(env.action_spec_unbatched)
        self.render_mode, self._camera, self._time_limit = render_mode, camera, time_limit
        # Gymnasium takes -1 for no limit.
        limited = max_episode_steps is not None and max_episode_steps != -1
        self._most = check_count(MAX_COUNT, max_episode_steps=max_episode_steps) if limited else None
        repeats = [part.repeat for part in env.modules() if isinstance(part, ActionRepeat)]
        self.frames_per_second = max(1, round(1 / (self.base_env.control_dt * math.prod(repeats))))
        self._root: TensorDictBase | None = None
        self._goals, self._actions = np.zeros(self.num_envs, np.int64), np.zeros(self.num_envs, np.int64)

    @property
    def total_steps(self) -> NDArray[np.int64]:
        """Number of steps of each row since it was last seeded, int64 ``[N]``."""
        return _flat(self._started("total_steps")["outcome", "total_steps"])

    def observation(self) -> Observation:
        return self.entry(EncodedObservation.KEY) if self._flat else {key: self.entry(key) for key in self._keys}

    def entry(self, key: str) -> NDArray[np.float32]:
        """One entry of the current observation, ``[N, k]``."""
        return in_rows(self._started("the observation")).get(key).numpy(force=True).copy()

    @with_torch_defaults
    def reset(
        self, rows: Mask | None = None, *, seed: int | None = None, options: Mapping[str, ArrayLike] | None = None
    ) -> Observation:
        """Begins the next episode in ``rows`` (bool ``[N]``), by default in all; returns the observation of every row.

        Row ``i`` gets the seed ``seed + i``. The options are ``"start"`` ``[N, 3]`` and ``"goal"`` ``[N, 2]``.
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
        self._goals[rows] = self._actions[rows] = 0
        return self.observation()

    @with_torch_defaults
    def step(self, actions: ArrayLike, rows: Mask | None = None) -> Step:
        """Takes one step with the actions ``[N, 2]`` in ``rows`` (bool ``[N]``), by default in all.

        No time passes for the other rows: their actions are ignored, and their reward is 0.
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
        # Otherwise the next step would skip the same rows.
        result.pop("_step", None)
        self._root = self.env.step_mdp(result)
        return self._unpack(result.get("next"), np.ones(self.num_envs, np.bool_) if rows is None else rows)

    def picture(self, row: int) -> NDArray[np.uint8]:
        """Renders one rover, uint8 ``[height, width, 3]``."""
        self._require_open("render")
        return self.base_env.render(row, self._camera).numpy(force=True)

    def _unpack(self, result: TensorDictBase, active: Mask) -> Step:
        outcome = result.get("outcome")
        reward = np.where(active, _flat(result.get("reward")).astype(np.float64), 0.0)
        events = {event: _flat(outcome.get(event)) & active for event in EVENTS}
        self._goals += _flat(outcome.get("goals")) * active if "goals" in outcome else events["goal_reached"]
        terminated, truncated = (_flat(result.get(key)) & active for key in ("terminated", "truncated"))
        if self._time_limit == "terminated":
            terminated, truncated = terminated | truncated, np.zeros_like(truncated)
        self._actions += active
        if self._most is not None:
            truncated = truncated | (active & (self._actions >= self._most))
        info: dict[str, NDArray[Any]] = {"steps": _flat(outcome.get("steps"))}
        if (world := outcome.get("world", None)) is not None:
            info["world"] = _flat(world)
        info |= {"total_steps": self.total_steps, "reward": reward.copy()}
        info |= {"goals": self._goals.copy(), "is_success": self._goals > 0, **events}
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


def pop_options(arguments: dict[str, Any]) -> dict[str, Any]:
    options = signature(NumpyBatch).parameters.keys() - {"env"}
    return {key: arguments.pop(key) for key in [*arguments] if key in options}


def base_env(env: EnvBase) -> RoverEnv:
    """Returns the :class:`RoverEnv` under the transforms of ``env``, or raises ``TypeError`` if there is none."""
    inner = env
    while isinstance(inner, TransformedEnv):
        inner = inner.base_env
    if not isinstance(inner, RoverEnv):
        raise TypeError(f"a rover_rl.RoverEnv, or a TransformedEnv of one, is needed; got {type(env).__name__}")
    return inner


def row_of(observation: Observation, row: int) -> Observation:
    if isinstance(observation, np.ndarray):
        return observation[row].copy()
    return {key: value[row].copy() for key, value in observation.items()}


def _require_one_of(name: str, value: object, allowed: tuple[object, ...]) -> None:
    if value not in allowed:
        raise ValueError(f"{name} must be one of {list(allowed)}, got {value!r}")


def _box(spec: TensorSpec) -> spaces.Box:
    if isinstance(spec, Bounded):
        low, high = spec.space.low.numpy(force=True), spec.space.high.numpy(force=True)
        return spaces.Box(low, high, dtype=np.float32)
    return spaces.Box(-np.inf, np.inf, tuple(spec.shape), np.float32)


def _flat(column: Tensor) -> NDArray[Any]:
    return column.reshape(-1).numpy(force=True).copy()
