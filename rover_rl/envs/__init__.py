"""The task: batched torch on any device, independent of the simulator.

Names are imported when they are asked for: :mod:`rover_rl.envs.config` needs no PyTorch.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rover_rl.envs.config import (
        ActionConfig,
        EnvConfig,
        HeadingGains,
        LidarConfig,
        Randomization,
        RewardConfig,
        TaskConfig,
    )
    from rover_rl.envs.control import HeadingController
    from rover_rl.envs.make import RewardedEnv, add_reward, make_env
    from rover_rl.envs.rewards import RewardComponent, TotalReward, contract_reward, register_reward
    from rover_rl.envs.rover import RoverEnv
    from rover_rl.envs.task import StepEvent

_HOMES = {
    "config": (
        "ActionConfig",
        "EnvConfig",
        "HeadingGains",
        "LidarConfig",
        "Randomization",
        "RewardConfig",
        "TaskConfig",
    ),
    "control": ("HeadingController",),
    "make": ("RewardedEnv", "add_reward", "make_env"),
    "rewards": ("RewardComponent", "TotalReward", "contract_reward", "register_reward"),
    "rover": ("RoverEnv",),
    "task": ("StepEvent",),
}
_HOME = {name: module for module, names in _HOMES.items() for name in names}

__all__ = [
    "ActionConfig",
    "EnvConfig",
    "HeadingController",
    "HeadingGains",
    "LidarConfig",
    "Randomization",
    "RewardComponent",
    "RewardConfig",
    "RewardedEnv",
    "RoverEnv",
    "StepEvent",
    "TaskConfig",
    "TotalReward",
    "add_reward",
    "contract_reward",
    "make_env",
    "register_reward",
]


def __getattr__(name: str) -> Any:
    """Imports a public name when it is first asked for."""
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = globals()[name] = getattr(import_module(f"{__name__}.{_HOME[name]}"), name)
    return value
