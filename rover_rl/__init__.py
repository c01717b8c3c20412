"""Batched reinforcement-learning environment for rovers that navigate on rough terrain.

Packages:
    ``rover_rl.envs``: the environment: observations, actions, rewards, configuration, and the Gymnasium and
    Stable-Baselines3 classes.
    ``rover_rl.sims``: simulation and hardware backends, robots and worlds.
    ``rover_rl.algos``: PPO and SAC: training, evaluation, video and deployment.
    ``rover_rl.cli``: the ``rover-rl`` command.

Public names are imported on first use, so that ``rover-rl --help`` and Gymnasium's registration do not import PyTorch.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

import gymnasium

if TYPE_CHECKING:
    from rover_rl.envs import (
        ActionConfig,
        Bounds,
        EnvConfig,
        LidarConfig,
        PoseConfig,
        Randomization,
        RewardComponent,
        RewardConfig,
        RoverEnv,
        Sensor,
        TaskConfig,
        contract_reward,
        make_env,
        register_reward,
        register_sensor,
    )
    from rover_rl.envs.gym import GymVectorWrapper, GymWrapper
    from rover_rl.robots import Robot, RobotOptions, register_robot
    from rover_rl.sims.backends import register_backend
    from rover_rl.worlds import Terrain, World, box, cylinder, register_world

__version__ = "0.1.0"

ENV_ID = "rover_rl/Rover-v0"
"""Gymnasium ID of the environment."""
LEARNING_ENV_ID = "rover_rl/Rover5Hz-v0"
"""Gymnasium ID of the environment with settings for the algorithms of other libraries: an action every 0.2 s, one
vector of scaled observations, a scaled reward, ``truncated`` at the time limit, and Warp."""
LEARNING_DEFAULTS: dict[str, Any] = {
    "action_repeat": 4,
    "reward_scale": 0.05,
    "scale_observations": True,
    "time_limit": "truncated",
    "backend": "warp",
}
"""Arguments that this ID stands for."""

if ENV_ID not in gymnasium.registry:
    for id_, defaults in ((ENV_ID, {}), (LEARNING_ENV_ID, LEARNING_DEFAULTS)):
        gymnasium.register(
            id=id_,
            entry_point="rover_rl.envs.gym:RoverEnv",
            vector_entry_point="rover_rl.envs.gym:make_vector_env",
            kwargs=defaults,
        )

__all__ = [
    "ENV_ID",
    "LEARNING_DEFAULTS",
    "LEARNING_ENV_ID",
    "ActionConfig",
    "Bounds",
    "EnvConfig",
    "GymVectorWrapper",
    "GymWrapper",
    "LidarConfig",
    "PoseConfig",
    "Randomization",
    "RewardComponent",
    "RewardConfig",
    "Robot",
    "RobotOptions",
    "RoverEnv",
    "Sensor",
    "TaskConfig",
    "Terrain",
    "World",
    "__version__",
    "box",
    "contract_reward",
    "cylinder",
    "make_env",
    "register_backend",
    "register_reward",
    "register_robot",
    "register_sensor",
    "register_world",
]


_OUTSIDE_OF_ENVS = {
    "rover_rl.envs.gym": ("GymVectorWrapper", "GymWrapper"),
    "rover_rl.sims.backends": ("register_backend",),
    "rover_rl.robots": ("Robot", "RobotOptions", "register_robot"),
    "rover_rl.worlds": ("Terrain", "World", "box", "cylinder", "register_world"),
}
"""Public names that are not in ``rover_rl.envs``, by module."""
_HOMES = {name: module for module, names in _OUTSIDE_OF_ENVS.items() for name in names}


def __getattr__(name: str) -> Any:
    """Imports a public name on first use."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = globals()[name] = getattr(import_module(_HOMES.get(name, "rover_rl.envs")), name)
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
