"""Check of spawn poses: resets many rovers and applies zero actions for 20 steps.

    python benchmarks/spawn.py --resets 10000

Prints for each world how many rovers flipped, jammed, collided, left the bounds or were stuck, the smallest lidar
reading, and the largest displacement.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
import tyro

from rover_rl import RoverEnv

EVENTS = ("flipped", "jammed", "collision", "out_of_bounds", "stuck")


@dataclass
class Options:
    """Options of the check."""

    worlds: list[str] = field(default_factory=lambda: ["inspect", "moon", "maze"])
    """Names of the worlds."""
    resets: int = 10_000
    """Number of resets in each world."""
    num_envs: int = 250
    """Number of rovers in the batch."""
    seed: int = 0
    """Seed of the first rover."""


def check(world: str, options: Options) -> None:
    """Checks one world and prints the results."""
    env = RoverEnv(world_n=world, num_envs=options.num_envs, seed=options.seed)
    zero = torch.zeros(options.num_envs, 2)
    counts = dict.fromkeys(EVENTS, 0)
    nearest, moved = float("inf"), 0.0
    batches = -(-options.resets // options.num_envs)
    for _ in range(batches):
        td = env.reset()
        start = td["pose"]
        happened = {event: torch.zeros(options.num_envs, 1, dtype=torch.bool) for event in EVENTS}
        for _ in range(20):
            nearest = min(nearest, td["lidar"].min().item())
            td = env.step(td.set("action", zero))["next"]
            for event in EVENTS:
                happened[event] |= td["outcome", event]
        moved = max(moved, (td["pose"] - start).norm(dim=-1).max().item())
        counts = {event: counts[event] + int(happened[event].sum()) for event in EVENTS}
    env.close()
    print(
        f"{world}: {batches * options.num_envs} resets, {counts}, nearest {nearest:.3f} m, moved {moved * 1e3:.1f} mm"
    )


if __name__ == "__main__":
    options = tyro.cli(Options, description=__doc__)
    torch.set_num_threads(1)
    for name in options.worlds:
        check(name, options)
