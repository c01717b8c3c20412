"""Policies that Stable-Baselines3 saved. Loading a file runs code in it, as Stable-Baselines3 does: load your own.

Example:
    >>> from stable_baselines3 import PPO
    >>> from rover_rl.envs.sb3 import SB3VecEnv
    >>> PPO("MultiInputPolicy", SB3VecEnv(RoverEnv(world_n="maze", num_envs=4))).save("ppo.zip")
    >>> evaluate(SB3Policy(Path("ppo.zip")), stored_episodes("maze").first(4), seconds=2)
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from tensordict import TensorDictBase

from rover_rl.envs.actions import action_bounds
from rover_rl.envs.config import ActionConfig, EnvConfig, LidarConfig
from rover_rl.envs.encoding import ObservationEncoder
from rover_rl.envs.sensors.suite import environment_sensors


class SB3Policy:
    """Policy of PPO, A2C, SAC, TD3 or TQC from a file of Stable-Baselines3, without exploration.

    Observations are a dictionary, flattened by Gymnasium, or scaled (``scale_observations``). Statistics of
    ``VecNormalize`` are not in the file: policies that were trained with it do not drive. ``made_for`` has the lidar
    and the bounds of the action. A file does not tell what its numbers are: if they are as many as in the observation
    and the action of ``env``, of which a task reads the entries ``observation``, they are taken for these.

    Raises:
        FileNotFoundError: if there is no such file.
        ImportError: if Stable-Baselines3 is not installed.
        ValueError: if the file is damaged or holds another kind of policy.
    """

    def __init__(self, path: Path, env: EnvConfig | None = None, observation: tuple[str, ...] = ()) -> None:
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
        if env is not None and (observe := _observation_in(env, observation, space, actions)) is not None:
            self.made_for, self._observe = env, observe
            return
        if not isinstance(actions, spaces.Box) or actions.shape != (2,):
            raise ValueError(f"{path} was trained with other actions than those of rover_rl")
        (low, _), (high, turn) = actions.low.tolist(), actions.high.tolist()
        # In float32, pi is a little more than math.pi.
        turn = math.pi if math.isclose(turn, math.pi, rel_tol=1e-6) else turn
        action = ActionConfig(min_speed=low, max_speed=high, max_turn=turn)
        lidar, self._observe = _observation(space, path)
        self.made_for = EnvConfig(lidar=lidar, action=action)

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), self._given

    def __call__(self, now: TensorDictBase) -> TensorDictBase:
        action, _ = self._policy.predict(self._observe(now), deterministic=True)
        return now.set("action", torch.from_numpy(action).to(now["lidar"].device))


def _observation_in(
    env: EnvConfig, keys: tuple[str, ...], space: spaces.Space[Any], actions: spaces.Space[Any]
) -> Callable[[TensorDictBase], Any] | None:
    """Returns the function that makes observations, scaled or not, if they and the actions are those of ``env``."""
    encoder, bounds = ObservationEncoder.of(env, keys), action_bounds(env.bounded_action)
    if not (isinstance(actions, spaces.Box) and actions.shape == (len(bounds.low),)):
        return None
    if not (np.allclose(actions.low, bounds.low) and np.allclose(actions.high, bounds.high)):
        return None
    if isinstance(space, spaces.Dict):
        shapes = {key: (len(encoder.sensors[key].bounds.low),) for key in keys}
        return _entries(keys) if {key: each.shape for key, each in space.items()} == shapes else None
    return _scaled(encoder) if space.shape == (encoder.features,) else None


def _entries(keys: Iterable[str]) -> Callable[[TensorDictBase], Any]:
    return lambda now: {key: now[key].numpy(force=True) for key in keys}


def _scaled(encoder: ObservationEncoder) -> Callable[[TensorDictBase], Any]:
    return lambda now: encoder(*(now[key] for key in encoder.keys)).numpy(force=True)


def _observation(space: spaces.Space[Any], path: Path) -> tuple[LidarConfig, Callable[[TensorDictBase], Any]]:
    """Returns the lidar, and the function that makes observations of a space from a tensordict."""
    sensors = environment_sensors(LidarConfig())
    if isinstance(space, spaces.Dict) and "lidar" in space.keys() and {*space} <= {*sensors}:  # noqa: SIM118
        ranges = space["lidar"]
        assert isinstance(ranges, spaces.Box)
        lidar = LidarConfig(points=ranges.shape[0], max_range=float(ranges.high[0]))
        return lidar, _entries([*space])
    flattened = isinstance(space, spaces.Box) and bool(np.isfinite(space.low).all())
    others = sum(len(sensor.bounds.low) for key, sensor in sensors.items() if key != "lidar")
    points = (space.shape or (0,))[0] - (others if flattened else ObservationEncoder(lidar_points=1).features - 1)
    if points < 1:
        raise ValueError(f"{path} was trained with other observations than those of rover_rl")
    if flattened:
        return LidarConfig(points=points), lambda now: torch.cat([now[key] for key in sorted(sensors)], -1).numpy()
    return LidarConfig(points=points), _scaled(ObservationEncoder(lidar_points=points))
