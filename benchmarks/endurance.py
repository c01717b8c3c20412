"""Robustness of the Warp backend under millions of random actions: counts NaNs, and records extreme heights."""

from __future__ import annotations

from functools import partial
from typing import Any

import torch
from rich.table import Table

from benchmarks.options import Options
from benchmarks.told import told
from rover_rl import RoverEnv

WORLDS = ("inspect", "moon", "maze")
ACTION_REPEAT = 10
"""Number of steps for which an action is held."""


def measure(options: Options) -> list[dict[str, Any]]:
    """Runs an equal share of the steps in each world."""
    rovers, steps = options.warp_envs, options.endurance // len(WORLDS)
    return [told(f"random actions, {world}", partial(_drive_randomly, world, rovers, steps)) for world in WORLDS]


def _drive_randomly(world: str, rovers: int, total: int) -> dict[str, Any]:
    """Runs ``total`` steps of random actions and returns the extremes found."""
    env = RoverEnv(world_n=world, num_envs=rovers, lidar_beams=32, backend="warp", seed=0)
    ground = env.worlds[0]
    random = torch.Generator().manual_seed(0)
    space, td = env.action_spec.space, env.reset()
    steps = broken = 0
    highest, lowest = -float("inf"), float("inf")
    while steps < total:
        if steps // rovers % ACTION_REPEAT == 0:
            action = space.low + (space.high - space.low) * torch.rand(rovers, 2, generator=random)
        after = env.step(td.set("action", action))["next"]
        # Measured before the rovers whose episodes have ended are reset.
        state = env.rover_state
        above = state.position[:, 2] - ground.height_at(state.position[:, :2])
        finite = torch.isfinite(state.position).all(-1) & torch.isfinite(state.orientation).all(-1)
        broken += int((~finite).sum())
        highest, lowest = max(highest, above.max().item()), min(lowest, above.min().item())
        steps += rovers
        td = env.maybe_reset(after)
    env.close()
    return {"world": world, "steps": steps, "broken": broken, "highest_m": highest, "lowest_m": lowest}


def table(rows: list[dict[str, Any]]) -> Table:
    """Formats the results as a table for the terminal."""
    table = Table("world", "steps", "NaN or infinite", "highest, m", "lowest, m", title="Warp: random actions")
    for row in rows:
        figures = f"{row['highest_m']:.2f}", f"{row['lowest_m']:.2f}"
        table.add_row(row["world"], f"{row['steps']:,}", str(row["broken"]), *figures)
    return table
