"""rover_rl: point navigation on rough ground for reinforcement learning, batched."""

from __future__ import annotations

from rover_rl.envs import RewardComponent, RewardConfig, RoverEnv, TaskConfig, contract_reward, make_env
from rover_rl.envs.gym import GymVectorWrapper, GymWrapper
from rover_rl.envs.gym import register as _register
from rover_rl.sims.robots import Robot
from rover_rl.sims.worlds import Terrain, World, box, cylinder

__version__ = "0.1.0"

_register()

__all__ = [
    "GymVectorWrapper",
    "GymWrapper",
    "RewardComponent",
    "RewardConfig",
    "Robot",
    "RoverEnv",
    "TaskConfig",
    "Terrain",
    "World",
    "__version__",
    "box",
    "contract_reward",
    "cylinder",
    "make_env",
]
