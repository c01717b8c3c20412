"""MuJoCo backend: rigid-body physics and lidar rays in MuJoCo, for CPUs; checks the other two simulators.

Importing this module does not require MuJoCo; building a simulator does.
"""

from __future__ import annotations

from rover_rl.sims.mujoco.settings import MujocoSettings

__all__ = ["MujocoSettings"]
