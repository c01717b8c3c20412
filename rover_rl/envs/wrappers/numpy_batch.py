"""NumPy interface of the environment, shared by the Gymnasium and Stable-Baselines3 classes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, TypeAlias, get_args

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import ArrayLike, NDArray
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, TensorSpec
from torchrl.envs import EnvBase

from rover_rl.checks import MAX_COUNT, check_count, check_seed
from rover_rl.envs.task import EVENTS
from rover_rl.envs.transforms.encoded_observation import EncodedObservation
from rover_rl.envs.wrappers.learning_options import LearningOptions, Reward, base_env, steps_per_action, with_options
from rover_rl.sims.base import View
from rover_rl.tensordicts import in_rows
from rover_rl.torch_defaults import with_torch_defaults

if TYPE_CHECKING:
    from typing_extensions import Unpack

Observation: TypeAlias = Any
"""A dictionary of arrays by entry, or one array if observations are scaled. All arrays are float32."""
Mask: TypeAlias = NDArray[np.bool_]
TimeLimit: TypeAlias = Literal["terminated", "truncated"]


class WrapperOptions(LearningOptions, total=False):
    """Keyword arguments of the classes that wrap an environment: see :class:`~rover_rl.GymWrapper`."""

    reward: Reward | None
    time_limit: TimeLimit
    render_mode: str | None
    camera: View
    max_episode_steps: int | None


@dataclass(frozen=True)
class Step:
    """Result of a step, copied: observations ``[N, k]`` per entry, the others ``[N]``."""

    observation: Observation
    reward: NDArray[np.float64]
    terminated: Mask
    truncated: Mask
    info: dict[str, NDArray[Any]]

    @property
    def ended(self) -> Mask:
        """Whether the episode of each row ended in this step, bool ``[N]``."""
        return self.terminated | self.truncated


class NumpyBatch:
    """Resets, steps and renders a :class:`~rover_rl.envs.RoverEnv` with NumPy arrays: see ``GymWrapper``.

    Spaces are those of one row, after the transforms.
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
        **options: Unpack[LearningOptions],
    ) -> None:
        require_one_of("time_limit", time_limit, get_args(TimeLimit))
        require_one_of("render_mode", render_mode, (None, "rgb_array"))
        require_one_of("camera", camera, get_args(View))
        self.base_env = base_env(env)
        self.env, self.reward_config = with_options(env, reward, options)
        self._flat = bool(options.get("scale_observations"))
        self.num_envs: int = self.base_env.num_envs
        self.observation_space = _observation_space(self.env, self._flat)
        self.action_space = _box(self.env.action_spec_unbatched)
        self.render_mode, self._camera, self._time_limit = render_mode, camera, time_limit
        # Gymnasium takes -1 for no limit.
        limited = max_episode_steps is not None and max_episode_steps != -1
        self._most = check_count(MAX_COUNT, max_episode_steps=max_episode_steps) if limited else None
        self._actions = np.zeros(self.num_envs, np.int64)
        self._root: TensorDictBase | None = None
        self._goals = np.zeros(self.num_envs, np.int64)

    @property
    def frames_per_second(self) -> int:
        """Frame rate of a video with one image per step."""
        return max(1, round(1 / (self.base_env.control_dt * steps_per_action(self.env))))

    @property
    def total_steps(self) -> NDArray[np.int64]:
        """Number of steps of each row since it was last seeded, int64 ``[N]``."""
        return _flat(self._started("total_steps")["outcome", "total_steps"])

    def observation(self) -> Observation:
        """Returns the current observation, ``[N, k]`` per entry, or ``[N, n]`` if observations are scaled."""
        if self._flat:
            return self.entry(EncodedObservation.KEY)
        return {key: self.entry(key) for key in self.base_env.sensors}

    def entry(self, key: str) -> NDArray[np.float32]:
        """Returns one entry of the current observation, ``[N, k]``."""
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
        return self._unpack(result.get("next"), rows)

    def picture(self, row: int) -> NDArray[np.uint8]:
        """Renders one rover, uint8 ``[height, width, 3]``."""
        self._require_open("render")
        return self.base_env.render(row, self._camera).numpy(force=True)

    def _unpack(self, result: TensorDictBase, rows: Mask | None) -> Step:
        active = np.ones(self.num_envs, np.bool_) if rows is None else rows
        outcome = result.get("outcome")
        reward = np.where(active, _flat(result.get("reward")).astype(np.float64), 0.0)
        events = {event: _flat(outcome.get(event)) & active for event in EVENTS}
        self._goals += _flat(outcome.get("goals")) * active if "goals" in outcome else events["goal_reached"]
        terminated = _flat(result.get("terminated")) & active
        truncated = _flat(result.get("truncated")) & active
        if self._time_limit == "terminated":
            terminated, truncated = terminated | truncated, np.zeros_like(truncated)
        self._actions += active
        if self._most is not None:
            truncated = truncated | (active & (self._actions >= self._most))
        info: dict[str, NDArray[Any]] = {
            "steps": _flat(outcome.get("steps")),
            **({"world": _flat(world)} if (world := outcome.get("world", None)) is not None else {}),
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


def pop_options(arguments: dict[str, Any]) -> WrapperOptions:
    """Removes the options of :class:`WrapperOptions` from arguments, and returns them."""
    given: Any = {key: arguments.pop(key) for key in [*arguments] if key in WrapperOptions.__annotations__}
    return given


def row_of(observation: Observation, row: int) -> Observation:
    """Returns a copy of one row of an observation."""
    if isinstance(observation, np.ndarray):
        return observation[row].copy()
    return {key: value[row].copy() for key, value in observation.items()}


def require_one_of(name: str, value: object, allowed: tuple[object, ...]) -> None:
    """Raises ``ValueError`` unless an option has one of the allowed values."""
    if value not in allowed:
        raise ValueError(f"{name} must be one of {list(allowed)}, got {value!r}")


def _observation_space(env: EnvBase, flat: bool) -> spaces.Space[Any]:
    if flat:
        return _box(env.observation_spec_unbatched[EncodedObservation.KEY])
    keys = [*base_env(env).sensors]
    if missing := [key for key in keys if key not in env.observation_spec]:
        raise ValueError(f"the observation lacks {missing}, which a transform has removed; {keys} are needed")
    return spaces.Dict({key: _box(env.observation_spec_unbatched[key]) for key in keys})


def _box(spec: TensorSpec) -> spaces.Box:
    """Returns the space of the spec of one row."""
    if isinstance(spec, Bounded):
        low, high = spec.space.low.numpy(force=True), spec.space.high.numpy(force=True)
        return spaces.Box(low, high, dtype=np.float32)
    return spaces.Box(-np.inf, np.inf, tuple(spec.shape), np.float32)


def _flat(column: Tensor) -> NDArray[Any]:
    """Copies ``[N, 1]``, or ``[1]`` of an unbatched environment, to an array ``[N]``."""
    return column.reshape(-1).numpy(force=True).copy()
