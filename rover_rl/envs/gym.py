"""Gymnasium classes: ``RoverEnv`` (drop-in replacement for the original), ``GymWrapper`` and ``GymVectorWrapper``."""

from __future__ import annotations

from rover_rl.envs.wrappers.gym import GymWrapper, RoverEnv
from rover_rl.envs.wrappers.gym_vector import GymVectorWrapper, make_vector_env

__all__ = ["GymVectorWrapper", "GymWrapper", "RoverEnv", "make_vector_env"]
