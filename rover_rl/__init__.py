"""Batched reinforcement-learning environment for rovers that navigate on rough terrain.

Packages:
    ``rover_rl.envs``: the environment: observations, actions, rewards, configuration, and the Gymnasium and
    Stable-Baselines3 classes.
    ``rover_rl.tasks``: named tasks, with worlds to train and to test in.
    ``rover_rl.sims``: simulators, one of which is a real rover.
    ``rover_rl.robots``, ``rover_rl.worlds``: robots and worlds.
    ``rover_rl.algos``: PPO and SAC: training, evaluation, video and deployment.
    ``rover_rl.cli``: the ``rover-rl`` command.

Public names are imported on first use, so that ``rover-rl --help`` and Gymnasium's registration do not import PyTorch.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

import gymnasium

from rover_rl.envs.parts import TASKS, task_gym_id

if TYPE_CHECKING:
    from rover_rl.envs.actions import Action as Action
    from rover_rl.envs.config import ActionConfig as ActionConfig
    from rover_rl.envs.config import EnvConfig as EnvConfig
    from rover_rl.envs.config import LidarConfig as LidarConfig
    from rover_rl.envs.config import PoseConfig as PoseConfig
    from rover_rl.envs.config import Randomization as Randomization
    from rover_rl.envs.config import RewardConfig as RewardConfig
    from rover_rl.envs.config import TaskConfig as TaskConfig
    from rover_rl.envs.events import Event as Event
    from rover_rl.envs.gym import GymVectorWrapper as GymVectorWrapper
    from rover_rl.envs.gym import GymWrapper as GymWrapper
    from rover_rl.envs.make import make_env as make_env
    from rover_rl.envs.parts import register_action as register_action
    from rover_rl.envs.parts import register_event as register_event
    from rover_rl.envs.parts import register_task as register_task
    from rover_rl.envs.parts import register_termination as register_termination
    from rover_rl.envs.rewards import RewardComponent as RewardComponent
    from rover_rl.envs.rewards import contract_reward as contract_reward
    from rover_rl.envs.rewards import register_reward as register_reward
    from rover_rl.envs.rover import RoverEnv as RoverEnv
    from rover_rl.envs.sensors.base import Sensor as Sensor
    from rover_rl.envs.sensors.suite import register_sensor as register_sensor
    from rover_rl.envs.specs import Bounds as Bounds
    from rover_rl.envs.terminations import Termination as Termination
    from rover_rl.robots import Robot as Robot
    from rover_rl.robots import RobotOptions as RobotOptions
    from rover_rl.robots import register_robot as register_robot
    from rover_rl.sims.backends import register_backend as register_backend
    from rover_rl.tasks.task import Task as Task
    from rover_rl.tasks.task import get_task as get_task
    from rover_rl.worlds import Terrain as Terrain
    from rover_rl.worlds import World as World
    from rover_rl.worlds import box as box
    from rover_rl.worlds import cylinder as cylinder
    from rover_rl.worlds import register_world as register_world

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


def _register_gymnasium() -> None:
    of_task = {task_gym_id(name): {"task": name, **LEARNING_DEFAULTS} for name in TASKS.names()}
    for id_, defaults in {ENV_ID: {}, LEARNING_ENV_ID: LEARNING_DEFAULTS, **of_task}.items():
        if id_ not in gymnasium.registry:
            gymnasium.register(
                id=id_,
                entry_point="rover_rl.envs.gym:RoverEnv",
                vector_entry_point="rover_rl.envs.gym:make_vector_env",
                kwargs=defaults,
            )


_register_gymnasium()

_HOMES = {
    "rover_rl.envs.config": "ActionConfig EnvConfig LidarConfig PoseConfig Randomization RewardConfig TaskConfig",
    "rover_rl.envs.actions": "Action",
    "rover_rl.envs.events": "Event",
    "rover_rl.envs.parts": "register_action register_event register_task register_termination",
    "rover_rl.envs.terminations": "Termination",
    "rover_rl.tasks.task": "Task get_task",
    "rover_rl.envs.gym": "GymVectorWrapper GymWrapper",
    "rover_rl.envs.make": "make_env",
    "rover_rl.envs.rewards": "RewardComponent contract_reward register_reward",
    "rover_rl.envs.rover": "RoverEnv",
    "rover_rl.envs.sensors.base": "Sensor",
    "rover_rl.envs.sensors.suite": "register_sensor",
    "rover_rl.envs.specs": "Bounds",
    "rover_rl.robots": "Robot RobotOptions register_robot",
    "rover_rl.sims.backends": "register_backend",
    "rover_rl.worlds": "Terrain World box cylinder register_world",
}
"""Public names by module."""
_HOME = {name: module for module, names in _HOMES.items() for name in names.split()}
__all__ = ["ENV_ID", "LEARNING_DEFAULTS", "LEARNING_ENV_ID", "__version__", *_HOME]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = globals()[name] = getattr(import_module(_HOME[name]), name)
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *_HOME})
