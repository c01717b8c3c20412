"""The task: batched torch on any device. Knows no backend."""

from __future__ import annotations

from rover_rl.envs.control import HeadingController, HeadingGains
from rover_rl.envs.make import RewardedEnv, add_reward, make_env
from rover_rl.envs.randomization import Randomization
from rover_rl.envs.rewards import RewardComponent, RewardConfig, TotalReward, contract_reward
from rover_rl.envs.rover import RoverEnv
from rover_rl.envs.task import StepEvent, TaskConfig

__all__ = [
    "HeadingController",
    "HeadingGains",
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
]
