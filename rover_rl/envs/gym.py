"""Gymnasium classes: ``RoverEnv`` (drop-in for the original), ``GymWrapper`` and the vector environment."""

from __future__ import annotations

from rover_rl.envs.wrappers.gym import GymWrapper, RoverEnv
from rover_rl.envs.wrappers.gym_vector import GymVectorWrapper, make_vector_env

__all__ = ["GymVectorWrapper", "GymWrapper", "RoverEnv", "make_vector_env"]
