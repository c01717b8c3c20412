"""Rollouts that the tests of the GPU compare."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from torchrl.envs import EnvBase

from rover_rl import make_env

ROUGH = ("inspect", "moon", "maze")
"""Worlds of the contract."""


def environment(device: torch.device | str, rovers: int, **settings: Any) -> EnvBase:
    """Makes an environment in Warp, by default in the maze, with episodes of 30 steps."""
    given = {"world_n": "maze", "seed": 7, "length": 30, "backend": "warp", **settings}
    return make_env(num_envs=rovers, device=str(device), **given)


def drive(env: EnvBase, steps: int) -> list[TensorDictBase]:
    """Steps with actions that depend on the row and the step only, with resets. Returns the steps on the CPU."""
    td, seen = env.reset(), []
    rows = torch.arange(env.batch_size[0], dtype=torch.float32, device=env.device)
    for step in range(steps):
        # Exact in float32 on every device.
        action = torch.stack((0.25 + (rows % 4) / 4, ((rows + step // 8) % 5 - 2) / 2), -1)
        stepped, td = env.step_and_maybe_reset(td.set("action", action))
        seen.append(stepped["next"].to("cpu"))
    return seen
