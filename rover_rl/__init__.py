"""rover_rl: point navigation on rough ground for reinforcement learning, batched.

Names are imported when they are asked for, so that ``rover-rl --help`` and Gymnasium's registration need no PyTorch.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

import gymnasium

if TYPE_CHECKING:
    from rover_rl.envs import (
        Randomization,
        RewardComponent,
        RewardConfig,
        RoverEnv,
        TaskConfig,
        contract_reward,
        make_env,
    )
    from rover_rl.envs.gym import GymVectorWrapper, GymWrapper
    from rover_rl.sims.robots import Robot
    from rover_rl.sims.worlds import Terrain, World, box, cylinder

__version__ = "0.1.0"

ENV_ID = "rover_rl/Rover-v0"
"""Name under which Gymnasium knows the environment."""

if ENV_ID not in gymnasium.registry:
    gymnasium.register(
        id=ENV_ID,
        entry_point="rover_rl.envs.gym:RoverEnv",
        vector_entry_point="rover_rl.envs.gym:make_vector_env",
    )

_HOMES = {
    "rover_rl.envs": (
        "Randomization",
        "RewardComponent",
        "RewardConfig",
        "RoverEnv",
        "TaskConfig",
        "contract_reward",
        "make_env",
    ),
    "rover_rl.envs.gym": ("GymVectorWrapper", "GymWrapper"),
    "rover_rl.sims.robots": ("Robot",),
    "rover_rl.sims.worlds": ("Terrain", "World", "box", "cylinder"),
}
_HOME = {name: module for module, names in _HOMES.items() for name in names}

__all__ = [
    "ENV_ID",
    "GymVectorWrapper",
    "GymWrapper",
    "Randomization",
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


def __getattr__(name: str) -> Any:
    """Imports a public name when it is first asked for."""
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = globals()[name] = getattr(import_module(_HOME[name]), name)
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
