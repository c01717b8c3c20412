"""Policies that Stable-Baselines3 saved. Reading a file executes no code in it: nothing is unpickled.

Example:
    >>> from stable_baselines3 import PPO
    >>> from rover_rl.envs.sb3 import SB3VecEnv
    >>> PPO("MultiInputPolicy", SB3VecEnv(RoverEnv(world_n="maze", num_envs=4))).save("ppo.zip")
    >>> evaluate(SB3Policy(Path("ppo.zip")), stored_episodes("maze").first(4), seconds=5)
"""

from __future__ import annotations

import json
import math
import re
import zipfile
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from tensordict import TensorDictBase
from torch import Tensor

from rover_rl.algos.archives import checked_copy, first_not_finite
from rover_rl.envs.config import ActionConfig, EnvConfig, LidarConfig
from rover_rl.envs.encoding import ObservationEncoder
from rover_rl.envs.sensors.suite import environment_sensors
from rover_rl.envs.specs import action_bounds

_SAC = "stable_baselines3.sac.policies"
_KINDS = {
    "stable_baselines3.common.policies": ("stable_baselines3.common.policies", "ActorCriticPolicy", ""),
    _SAC: (_SAC, "SACPolicy", "actor."),
    "stable_baselines3.td3.policies": ("stable_baselines3.td3.policies", "TD3Policy", "actor."),
    # Its actor is SAC's; only its critics differ.
    "sb3_contrib.tqc.policies": (_SAC, "SACPolicy", "actor."),
}
"""By the module of a saved policy's class: a class that acts like it, and the prefix of the weights that act."""
_SETTINGS = ("net_arch", "use_sde", "log_std_init", "full_std", "use_expln", "squash_output", "clip_mean")
"""Settings of a policy that its actions depend on, and that are numbers and lists."""
_WITHOUT_EFFECT = ("ortho_init", "normalize_images", "optimizer_class", "optimizer_kwargs", "n_critics")
"""Settings of a policy that its actions do not depend on."""


class SB3Policy:
    """Policy of PPO, A2C, SAC, TD3 or TQC from a file of Stable-Baselines3, without exploration.

    Observations are a dictionary, flattened by Gymnasium, or scaled (``scale_observations``). Statistics of
    ``VecNormalize`` are not in the file: policies that were trained with it do not drive. ``made_for`` has the lidar
    and the bounds of the action.

    Raises:
        FileNotFoundError: if there is no such file.
        ImportError: if Stable-Baselines3 is not installed.
        ValueError: if the file is damaged or holds another kind of policy.
    """

    def __init__(self, path: Path) -> None:
        if not path.is_file():
            raise FileNotFoundError(f"no policy at {path}")
        self._path = path
        settings, weights = _read(path)
        lidar, observation_space, self._observe = _observation(settings.get("observation_space"), path)
        self.made_for = EnvConfig(lidar=lidar, action=_action(settings.get("action_space"), path))
        low, high = (bound.numpy() for bound in action_bounds(self.made_for.action).tensors(None))
        self._policy = _rebuild(settings, weights, observation_space, spaces.Box(low, high, dtype=np.float32), path)

    def __reduce__(self) -> tuple[type[SB3Policy], tuple[Path]]:
        return type(self), (self._path,)

    def __call__(self, now: TensorDictBase) -> TensorDictBase:
        """Sets ``"action"``, float32 ``[N, 2]``."""
        action, _ = self._policy.predict(self._observe(now), deterministic=True)
        return now.set("action", torch.from_numpy(action).to(now["lidar"].device))


def _read(path: Path) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """Returns the settings and the weights. Parts that Stable-Baselines3 pickled stay text."""
    try:
        with zipfile.ZipFile(path) as archive:
            settings = json.loads(archive.read("data"))
            content = archive.read("policy.pth")
        weights = torch.load(checked_copy(content), map_location="cpu", weights_only=True)
        name = first_not_finite(weights)
    except Exception as error:  # a damaged file can fail in any way
        raise ValueError(f"{path} is damaged, or no policy of Stable-Baselines3") from error
    if not isinstance(settings, dict) or name is not None:
        raise ValueError(f"{path} is damaged: {'it has no settings' if name is None else f'{name} is not finite'}")
    return settings, weights


def _rebuild(
    settings: dict[str, Any],
    weights: dict[str, Tensor],
    observations: spaces.Space[Any],
    actions: spaces.Box,
    path: Path,
) -> Any:
    """Builds the policy, a ``BasePolicy`` of Stable-Baselines3, and loads the weights that act."""
    module = (settings.get("policy_class") or {}).get("__module__")
    if module not in _KINDS:
        raise ValueError(f"{path} holds a policy of {module}; PPO, A2C, SAC, TD3 and TQC without memory are supported")
    home, name, prefix = _KINDS[module]
    try:
        kind, layers = getattr(import_module(home), name), import_module("stable_baselines3.common.torch_layers")
    except ImportError as error:
        raise ImportError('policies of Stable-Baselines3 need it: pip install "rover_rl[sb3]"') from error
    arguments = _arguments(settings, path)
    if isinstance(observations, spaces.Dict):
        arguments["features_extractor_class"] = layers.CombinedExtractor
    policy = kind(observations, actions, lambda _: 0.0, **arguments)
    part = policy.actor if prefix else policy
    try:
        part.load_state_dict({key.removeprefix(prefix): w for key, w in weights.items() if key.startswith(prefix)})
    except RuntimeError as error:
        raise ValueError(f"{path}: the weights do not fit net_arch={arguments.get('net_arch')}") from error
    return policy


def _arguments(settings: dict[str, Any], path: Path) -> dict[str, Any]:
    """Returns the settings of the policy that are plain data, and the activation function by its name in PyTorch."""
    given = {key: value for key, value in (settings.get("policy_kwargs") or {}).items() if not key.startswith(":")}
    arguments = {key: value for key, value in given.items() if key in _SETTINGS}
    if settings.get("use_sde"):
        arguments["use_sde"] = True
    if "activation_fn" in given:
        found = re.fullmatch(r"<class 'torch\.nn\.modules\.activation\.(\w+)'>", str(given["activation_fn"]))
        if found is None:
            raise ValueError(f"{path}: activation_fn must be one of PyTorch's, got {given['activation_fn']}")
        arguments["activation_fn"] = getattr(torch.nn, found[1])
    if unknown := sorted(given.keys() - arguments.keys() - {*_WITHOUT_EFFECT}):
        raise ValueError(f"{path}: a policy with {', '.join(unknown)} cannot be read without running code in the file")
    return arguments


def _observation(
    space: Any, path: Path
) -> tuple[LidarConfig, spaces.Space[Any], Callable[[TensorDictBase], dict[str, NDArray[Any]] | NDArray[Any]]]:
    """Returns the lidar, the observation space and the function that makes observations of it from a tensordict."""
    space = space if isinstance(space, dict) else {}
    entries = re.findall(r"'(\w+)': Box\(([^()]*), \((\d+),\)", str(space.get("spaces")))
    sensors = environment_sensors(LidarConfig())
    if entries and {key for key, _, _ in entries} <= set(sensors) and any(key == "lidar" for key, _, _ in entries):
        sizes = {key: int(size) for key, _, size in entries}
        high = next(float(numbers.split(", ")[-1]) for key, numbers, _ in entries if key == "lidar")
        boxes = spaces.Dict({key: spaces.Box(-np.inf, np.inf, (size,), np.float32) for key, size in sizes.items()})
        lidar = LidarConfig(points=sizes["lidar"], max_range=high)
        return lidar, boxes, lambda now: {key: now[key].numpy(force=True) for key in sizes}
    size = next(iter(space.get("_shape") or ()), 0)
    flattened = "True" in str(space.get("bounded_below"))
    others = sum(len(sensor.bounds.low) for key, sensor in sensors.items() if key != "lidar")
    points = size - (others if flattened else ObservationEncoder(lidar_points=1).features - 1)
    if points < 1:
        raise ValueError(f"{path} was trained with other observations than those of rover_rl")
    lidar, box = LidarConfig(points=points), spaces.Box(-np.inf, np.inf, (size,), np.float32)
    if flattened:
        return lidar, box, lambda now: torch.cat([now[key] for key in sorted(sensors)], -1).numpy(force=True)
    encoder = ObservationEncoder(lidar_points=points)
    return lidar, box, lambda now: encoder(*(now[key] for key in encoder.keys)).numpy(force=True)


def _action(space: Any, path: Path) -> ActionConfig:
    """Returns the bounds of the action."""
    space = space if isinstance(space, dict) else {}
    low, high = ([float(number) for number in str(space.get(name)).strip("[]").split()] for name in ("low", "high"))
    if len(low) != 2 or len(high) != 2:
        raise ValueError(f"{path} was trained with other actions than those of rover_rl")
    # In float32, pi is a little more than math.pi.
    return ActionConfig(low[0], high[0], math.pi if math.isclose(high[1], math.pi, rel_tol=1e-6) else high[1])
