"""MuJoCo, imported with a clear error if it is not installed."""

from __future__ import annotations

try:
    import mujoco
    from mujoco.rollout import Rollout
except ImportError as error:
    raise ImportError("backend='mujoco' needs MuJoCo: pip install 'rover_rl[mujoco]'") from error

__all__ = ["Rollout", "mujoco"]
