"""Rover environment: observations, actions, goals, events and rewards, batched in PyTorch on any device.

The environment is independent of the simulator: see :mod:`rover_rl.sims`. "The contract" is the interface of the
original environment, RoboTerrain's ``RoverEnv``: its arguments, observation, action, events and reward.

Environment and configuration:
    ``make``: ``make_env``, which builds the environment with a reward.
    ``rover``: ``RoverEnv``, the TorchRL environment without the contract's reward.
    ``config``: ``EnvConfig`` and its parts, the description of an environment. Does not import PyTorch.
    ``rewards``: reward components as TorchRL transforms.
    ``gym``, ``sb3``: Gymnasium and Stable-Baselines3 classes, implemented in ``wrappers``.
    ``transforms``: TorchRL transforms for training.

Parts of ``RoverEnv``:
    ``sensors``: sensors, the entries of the observation.
    ``specs``: TorchRL specs of observation, action, reward and done flags.
    ``inputs``: validation of actions, start poses and goals.
    ``control``: heading controller, from an action to a velocity command.
    ``row_limits``, ``emergency_brake``, ``delays``: limits, brake and delay of commands; delay of sensors.
    ``perception``: state of the environment between two steps.
    ``navigation``, ``task``: goals, events, outcome and end of an episode.
    ``placement``: random start poses and goals in free space.
    ``imperfections``: imperfections of real rovers by name.
    ``privileged``: privileged observation for critics and experts.
    ``rng``: reproducible random numbers per row.
    ``rows``, ``devices``: views of unbatched tensordicts, and validation of devices.

Public names are imported on first use.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rover_rl.envs.config import (
        ActionConfig,
        EnvConfig,
        GuardConfig,
        HeadingGains,
        LidarConfig,
        LimitsConfig,
        PoseConfig,
        Randomization,
        RewardConfig,
        TaskConfig,
    )
    from rover_rl.envs.control import HeadingController
    from rover_rl.envs.imperfections import IMPERFECTIONS, imperfect
    from rover_rl.envs.make import RewardedEnv, add_reward, make_env
    from rover_rl.envs.rewards import RewardComponent, TotalReward, contract_reward, register_reward
    from rover_rl.envs.rover import RoverEnv
    from rover_rl.envs.sensors.base import Sensor, SensorInput
    from rover_rl.envs.sensors.suite import register_sensor
    from rover_rl.envs.specs import Bounds
    from rover_rl.envs.task import StepEvent

_HOMES = {
    "config": (
        "ActionConfig",
        "EnvConfig",
        "GuardConfig",
        "HeadingGains",
        "LidarConfig",
        "LimitsConfig",
        "PoseConfig",
        "Randomization",
        "RewardConfig",
        "TaskConfig",
    ),
    "imperfections": ("IMPERFECTIONS", "imperfect"),
    "control": ("HeadingController",),
    "make": ("RewardedEnv", "add_reward", "make_env"),
    "rewards": ("RewardComponent", "TotalReward", "contract_reward", "register_reward"),
    "rover": ("RoverEnv",),
    "sensors.base": ("Sensor", "SensorInput"),
    "sensors.suite": ("register_sensor",),
    "specs": ("Bounds",),
    "task": ("StepEvent",),
}
_HOME = {name: module for module, names in _HOMES.items() for name in names}

__all__ = [
    "IMPERFECTIONS",
    "ActionConfig",
    "Bounds",
    "EnvConfig",
    "GuardConfig",
    "HeadingController",
    "HeadingGains",
    "LidarConfig",
    "LimitsConfig",
    "PoseConfig",
    "Randomization",
    "RewardComponent",
    "RewardConfig",
    "RewardedEnv",
    "RoverEnv",
    "Sensor",
    "SensorInput",
    "StepEvent",
    "TaskConfig",
    "TotalReward",
    "add_reward",
    "contract_reward",
    "imperfect",
    "make_env",
    "register_reward",
    "register_sensor",
]


def __getattr__(name: str) -> Any:
    """Imports a public name on first use."""
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = globals()[name] = getattr(import_module(f"{__name__}.{_HOME[name]}"), name)
    return value
