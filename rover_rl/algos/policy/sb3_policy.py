"""Policies that Stable-Baselines3 saved. Loading a file runs code in it, as Stable-Baselines3 does: load your own.

Example:
    >>> from stable_baselines3 import PPO
    >>> from rover_rl.envs.sb3 import SB3VecEnv
    >>> PPO("MultiInputPolicy", SB3VecEnv(RoverEnv(world_n="maze", num_envs=4))).save("ppo.zip")
    >>> evaluate(SB3Policy(Path("ppo.zip")), stored_episodes("maze").first(4), seconds=2)
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from tensordict import TensorDictBase

from rover_rl.envs.actions import find_action
from rover_rl.envs.config import ActionConfig, EnvConfig, LidarConfig
from rover_rl.envs.encoding import ObservationEncoder
from rover_rl.envs.sensors.suite import environment_sensors


class SB3Policy:
    """Policy of PPO, A2C, SAC, TD3 or TQC from a file of Stable-Baselines3, without exploration.

    Observations are a dictionary, flattened by Gymnasium, or scaled (``scale_observations``). The file says neither
    which entries they have nor what the action means: those of the contract, or with :meth:`reading` of another
    environment. Statistics of ``VecNormalize`` are not in the file: policies that were trained with it do not drive.
    ``made_for`` has the lidar and the bounds of the action, or the given environment.

    Args:
        path: file that ``model.save`` wrote.
        env: environment to drive in; ``None``: the contract's, with the lidar and action that fit the file.
        observation: entries that the policy reads; ``None``: all, or those of ``ObservationEncoder.of``.

    Raises:
        FileNotFoundError: if there is no such file.
        ImportError: if Stable-Baselines3 is not installed.
        ValueError: if the file is damaged, or holds another kind of policy; in a call, or of ``made_for``, for a policy
            of other observations.
    """

    def __init__(self, path: Path, env: EnvConfig | None = None, observation: Sequence[str] | None = None) -> None:
        try:
            from stable_baselines3.common.policies import ActorCriticPolicy
            from stable_baselines3.common.save_util import load_from_zip_file
        except ImportError as error:
            raise ImportError('policies of Stable-Baselines3 need it: pip install "rover_rl[sb3]"') from error
        if not path.is_file():
            raise FileNotFoundError(f"no policy at {path}")
        self._given = path, env, observation
        try:
            data, weights, _ = load_from_zip_file(path, device="cpu")
            kind, space, actions = (data[key] for key in ("policy_class", "observation_space", "action_space"))  # type: ignore[index]
            noise = {"use_sde": data["use_sde"]} if issubclass(kind, ActorCriticPolicy) else {}  # type: ignore[index]
            self._policy = kind(space, actions, lambda _: 0.0, **noise, **data["policy_kwargs"])  # type: ignore[index]
            self._policy.load_state_dict(weights["policy"])
        except Exception as error:  # a damaged file can fail in any way
            raise ValueError(f"{path} is damaged, or no policy of Stable-Baselines3") from error
        if hasattr(self._policy, "lstm_actor"):
            raise ValueError(f"{path} holds a policy with memory, which is not supported")
        features = 2 if env is None else len(find_action(env.action.kind).bounds(env.bounded_action).low)
        if not isinstance(actions, spaces.Box) or actions.shape != (features,):
            raise ValueError(f"{path} was trained with other actions than those of {_whose(env)}")
        self._space, self._actions = space, actions

    @cached_property
    def made_for(self) -> EnvConfig:
        path, env, _ = self._given
        return _contract_env(self._space, self._actions, path) if env is None else env

    @cached_property
    def _observe(self) -> Callable[[TensorDictBase], Any]:
        path, env, observation = self._given
        return _observation(self._space, self.made_for, observation, f"{path} was trained with", _whose(env))

    def reading(self, env: EnvConfig, observation: Sequence[str]) -> SB3Policy:
        """Returns the policy for an environment, whose entries ``observation`` it was trained with."""
        return type(self)(self._given[0], env, observation)

    def __reduce__(self) -> tuple[type[SB3Policy], tuple[Any, ...]]:
        return type(self), self._given

    def __call__(self, now: TensorDictBase) -> TensorDictBase:
        action, _ = self._policy.predict(self._observe(now), deterministic=True)
        return now.set("action", torch.from_numpy(action).to(now.device or "cpu"))


def _whose(env: EnvConfig | None) -> str:
    return "rover_rl" if env is None else "the environment"


def _contract_env(space: spaces.Space[Any], actions: spaces.Box, path: Path) -> EnvConfig:
    """Returns the contract's environment with the lidar and the bounds of the action that a file was trained with."""
    (low, _), (high, turn) = actions.low.tolist(), actions.high.tolist()
    # In float32, pi is a little more than math.pi.
    turn = math.pi if math.isclose(turn, math.pi, rel_tol=1e-6) else turn
    action = ActionConfig(min_speed=low, max_speed=high, max_turn=turn)
    if isinstance(space, spaces.Dict):
        ranges, lidar = space.spaces.get("lidar"), LidarConfig()
        if isinstance(ranges, spaces.Box):
            lidar = LidarConfig(ranges.shape[0], max_range=float(ranges.high[0]))
        return EnvConfig(lidar=lidar, action=action)
    others = sum(len(sensor.bounds.low) for key, sensor in environment_sensors(LidarConfig()).items() if key != "lidar")
    scaled = ObservationEncoder(lidar_points=1).features - 1
    points = (space.shape or (0,))[0] - (others if _is_flattened(space) else scaled)
    if points < 1:
        raise ValueError(f"{path} was trained with other observations than those of rover_rl")
    return EnvConfig(lidar=LidarConfig(points=points), action=action)


def _is_flattened(space: spaces.Space[Any]) -> bool:
    """Whether Gymnasium flattened a dictionary, whose bounds remain. Scaled observations have none."""
    return isinstance(space, spaces.Box) and bool(np.isfinite(space.low).all())


def _observation(
    space: spaces.Space[Any], env: EnvConfig, observation: Sequence[str] | None, trained: str, whose: str
) -> Callable[[TensorDictBase], Any]:
    """Returns the function that makes observations of a space from a tensordict."""
    sensors = environment_sensors(env.lidar, env.own_sensors)
    if isinstance(space, spaces.Dict):
        if not {*space} <= {*sensors}:
            raise ValueError(f"{trained} the entries {[*space]}, and {whose} has {[*sensors]}")
        return lambda now: {key: now[key].numpy(force=True) for key in space}
    if _is_flattened(space):
        keys = sorted(observation or sensors)
        features = sum(len(sensors[key].bounds.low) for key in keys)
        made = lambda now: torch.cat([now[key] for key in keys], -1)  # noqa: E731
    else:
        encoder = ObservationEncoder.of(env, observation)
        features = encoder.features
        made = lambda now: encoder(*(now[key] for key in encoder.keys))  # noqa: E731
    if space.shape != (features,):
        raise ValueError(f"{trained} other observations, {space.shape}, than the {features} numbers of {whose}")
    return lambda now: made(now).numpy(force=True)
