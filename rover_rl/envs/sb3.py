"""Stable-Baselines3 class: ``SB3VecEnv``."""

from __future__ import annotations

from rover_rl.envs.wrappers.sb3 import SB3VecEnv

__all__ = ["SB3VecEnv"]
