"""Check of the generators of worlds: every layout is solvable, and difficulty costs the expert time.

    python -m benchmarks.generators --layouts 1000 --drives 100

For each generator and difficulty, layouts of the seeds from 10,000 up are generated. In each, free space is computed
and rovers stand still for a second where episodes start. The expert, who knows the map, then drives an episode with one
goal in each of the first layouts, in Warp. It fails if it flips, gets stuck or takes too long. A layout counts as
unsolvable if it has no free start or goal; that all starts lead to all goals is part of the free space.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import torch
import tyro
from rich.console import Console
from rich.table import Table
from torch import Tensor

from rover_rl import RoverEnv
from rover_rl.algos.policy.expert import PrivilegedExpert
from rover_rl.envs import TaskConfig
from rover_rl.files import write_json
from rover_rl.robots import get_robot
from rover_rl.sims.free_space import free_space
from rover_rl.worlds import WORLDS, World

EVENTS = ("flipped", "jammed", "collision", "out_of_bounds", "stuck")
STEPS_PER_SECOND = 20


@dataclass(frozen=True)
class Options:
    """Options of the check."""

    names: tuple[str, ...] = tuple(WORLDS)
    """Names of the generators."""
    difficulties: tuple[float, ...] = (0.0, 0.5, 1.0)
    """Difficulties of the layouts."""
    layouts: int = 1000
    """Number of layouts for each generator and difficulty."""
    drives: int = 100
    """Number of the first layouts in which the expert drives an episode."""
    first_seed: int = 10_000
    """Seed of the first layout."""
    spawns: int = 4
    """Number of starts that are checked in each layout."""
    seconds: float = 120.0
    """Time limit of an episode, s."""
    batch: int = 10
    """Number of layouts at once, which limits the memory."""
    out: Path = Path("runs/bench/generators.json")
    """Output file."""


def main(options: Options) -> None:
    """Checks all generators. Writes all results so far after each difficulty, and prints a table at the end."""
    torch.set_num_threads(1)
    options.out.parent.mkdir(parents=True, exist_ok=True)
    rows = []
    for name, difficulty in product(options.names, options.difficulties):
        rows.append({"generator": name, "difficulty": difficulty, **check(options, name, difficulty)})
        write_json(options.out, rows)
        print(*rows[-1].items(), flush=True)
    Console(width=140).print(table(rows))


def check(options: Options, name: str, difficulty: float) -> dict[str, float]:
    """Returns the results of one generator at one difficulty."""
    begin = time.perf_counter()
    worlds = [WORLDS[name](options.first_seed + k, difficulty=difficulty) for k in range(options.layouts)]
    generation = (time.perf_counter() - begin) / options.layouts
    solvable = list(filter(_is_solvable, worlds))
    failed_starts = sum(_failed_starts(options, batch) for batch in _batches(solvable, options.batch))
    episodes = [_drive(options, batch) for batch in _batches(solvable[: options.drives], options.batch)]
    reached, seconds, distance = (torch.cat(parts) for parts in zip(*episodes, strict=True))
    return {
        "layouts": options.layouts,
        "generation_ms": 1e3 * generation,
        "unsolvable": len(worlds) - len(solvable),
        "starts": options.spawns * len(solvable),
        "failed_starts": failed_starts,
        "episodes": len(reached),
        "success": float(reached.double().mean()),
        "seconds": float(seconds[reached].mean()),
        "seconds_per_meter": float(seconds[reached].sum() / distance[reached].sum()),
    }


def _failed_starts(options: Options, worlds: list[World]) -> int:
    """Number of rovers with an event in the second after their start, in which they stand still."""
    rows = options.spawns * len(worlds)
    env = RoverEnv(world_n=worlds, num_envs=rows, backend="warp", seed=options.first_seed)
    td = env.reset()
    failed = torch.zeros(rows, 1, dtype=torch.bool)
    for _ in range(20):
        td = env.step(td.set("action", torch.zeros(rows, 2)))["next"]
        for event in EVENTS:
            failed |= td["outcome", event]
    env.close()
    return int(failed.sum())


def _drive(options: Options, worlds: list[World]) -> tuple[Tensor, Tensor, Tensor]:
    """Drives the expert to the first goal in each world.

    Returns:
        Whether each goal is reached, the time until the end of each episode (s), and the straight distance from start
        to goal (m), ``[len(worlds)]`` each.
    """
    count, steps = len(worlds), round(options.seconds * STEPS_PER_SECOND)
    # In narrow places, a lidar reading below 0.3 m is no failure.
    env = RoverEnv(
        world_n=worlds,
        num_envs=count,
        backend="warp",
        seed=options.first_seed,
        length=steps,
        end_on_goal=True,
        task=TaskConfig(collision_window=steps),
    )
    expert = PrivilegedExpert(worlds, env.robot)
    td = env.reset()
    distance = (env.goal - td["pose"][:, :2]).norm(dim=-1)
    reached, ended = torch.zeros(count, dtype=torch.bool), torch.zeros(count, dtype=torch.int64)
    for step in range(1, steps + 1):
        td = env.step(td.set("action", expert.action(td)))["next"]
        now = td["done"].squeeze(-1) & (ended == 0)
        reached |= now & td["outcome", "goal_reached"].squeeze(-1)
        ended[now] = step
        if (ended > 0).all():
            break
    env.close()
    return reached, ended / STEPS_PER_SECOND, distance


def _is_solvable(world: World) -> bool:
    try:
        free_space(world, get_robot("rover_zero"))
    except ValueError:
        return False
    return True


def _batches(worlds: list[World], size: int) -> Iterator[list[World]]:
    return (worlds[first : first + size] for first in range(0, len(worlds), size))


def table(rows: list[dict]) -> Table:
    """Formats the rows for the terminal."""
    headers = ("generator", "difficulty", "ms a layout", "unsolvable", "failed starts", "success", "seconds", "s/m")
    result = Table(*headers, title="Generators of worlds: the expert's success and time")
    for row in rows:
        result.add_row(
            row["generator"],
            f"{row['difficulty']:g}",
            f"{row['generation_ms']:.1f}",
            f"{row['unsolvable']} of {row['layouts']}",
            f"{row['failed_starts']} of {row['starts']}",
            f"{100 * row['success']:.1f} % of {row['episodes']}",
            f"{row['seconds']:.1f}",
            f"{row['seconds_per_meter']:.2f}",
        )
    return result


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
