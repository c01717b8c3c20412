"""How fast batched rollouts are, and where the time goes.

    python benchmarks/rollout.py --world inspect

For each number of rovers: steps per second of ``step_and_maybe_reset`` with the contract's reward under random actions,
the time inside Bullet's ``stepSimulation`` and ``rayTestBatch``, and all else (read-out and motor calls, task, rewards,
TorchRL) for the bare environment and with the reward. Times are medians over the steps in which nothing was reset.
"""

from __future__ import annotations

import json
import os
import statistics
import time
from dataclasses import asdict, dataclass, field
from pathlib import Path

import torch
import tyro
from rich.console import Console
from rich.table import Table

from rover_rl import RoverEnv, make_env
from rover_rl.sims.bullet.library import pybullet


@dataclass
class Options:
    """What to measure."""

    world: str = "inspect"
    """World, by name."""
    num_envs: list[int] = field(default_factory=lambda: [1, 16, 64, 256, 1024])
    """Numbers of rovers."""
    beams: int = 128
    """Lidar beams of a rover."""
    seconds: float = 5.0
    """About how long each number of rovers is measured."""
    json: Path | None = None
    """Where to write the figures, if anywhere."""


@dataclass
class Row:
    """Figures of one environment; microseconds."""

    num_envs: int
    reward: bool
    steps_per_s: float
    physics_per_rover: float
    rays_per_rover: float
    else_per_batch: float

    @property
    def else_bar(self) -> float:
        """What all else may take: 600 us a batched step and 20 us a rover."""
        return 600 + 20 * self.num_envs


class Stopwatch:
    """Adds up the time inside one function of PyBullet."""

    def __init__(self, name: str) -> None:
        self.seconds = 0.0
        self._function = getattr(pybullet, name)
        setattr(pybullet, name, self)

    def __call__(self, *args, **kwargs):
        start = time.perf_counter()
        result = self._function(*args, **kwargs)
        self.seconds += time.perf_counter() - start
        return result

    def take(self) -> float:
        """The time since the last call, in seconds."""
        seconds, self.seconds = self.seconds, 0.0
        return seconds


def measure(env, seconds: float, watches: tuple[Stopwatch, Stopwatch]) -> Row:
    """Rolls out with random actions for about ``seconds``."""
    count = env.batch_size[0]
    actions = [env.action_spec.rand() for _ in range(16)]
    td = env.reset()
    totals, physics, rays = [], [], []
    all_steps = all_time = 0.0
    begin = time.perf_counter()
    step = 0
    while time.perf_counter() - begin < seconds or len(totals) < 5:
        td.set("action", actions[step % 16])
        for watch in watches:
            watch.take()
        start = time.perf_counter()
        result, td = env.step_and_maybe_reset(td)
        total = time.perf_counter() - start
        inside = [watch.take() for watch in watches]
        step += 1
        if step <= 3:
            continue
        all_steps, all_time = all_steps + count, all_time + total
        if not result["next", "done"].any() or step > 500:
            totals.append(total)
            physics.append(inside[0])
            rays.append(inside[1])
    rest = [t - p - r for t, p, r in zip(totals, physics, rays, strict=True)]
    return Row(
        num_envs=count,
        reward=not isinstance(env, RoverEnv),
        steps_per_s=all_steps / all_time,
        physics_per_rover=statistics.median(physics) / count * 1e6,
        rays_per_rover=statistics.median(rays) / count * 1e6,
        else_per_batch=statistics.median(rest) * 1e6,
    )


def show(rows: list[Row], options: Options) -> None:
    """Prints the table and the ratio of the largest to the smallest time per rover step."""
    table = Table(title=f"{options.world}, {options.beams} beams, {os.cpu_count()} cores, one process")
    for heading in (
        "rovers",
        "reward",
        "steps/s",
        "us/rover step",
        "stepSimulation",
        "rayTestBatch",
        "else us/batch",
        "bar",
        "else share",
    ):
        table.add_column(heading, justify="right")
    for row in rows:
        per_rover = row.physics_per_rover + row.rays_per_rover + row.else_per_batch / row.num_envs
        table.add_row(
            str(row.num_envs),
            "contract" if row.reward else "task",
            f"{row.steps_per_s:,.0f}",
            f"{per_rover:,.0f}",
            f"{row.physics_per_rover:,.0f}",
            f"{row.rays_per_rover:,.0f}",
            f"{row.else_per_batch:,.0f}",
            f"{row.else_bar:,.0f}",
            f"{row.else_per_batch / row.num_envs / per_rover:.1%}",
        )
    console = Console(width=120)
    console.print(table)
    rates = {row.num_envs: row.steps_per_s for row in rows if row.reward}
    if 16 in rates and 1024 in rates:
        console.print(f"time per rover step at 1024 rovers / at 16: {rates[16] / rates[1024]:.2f}")


def main(options: Options) -> None:
    """Measures and prints."""
    torch.set_num_threads(1)
    watches = Stopwatch("stepSimulation"), Stopwatch("rayTestBatch")
    rows = []
    for count in options.num_envs:
        for make in (RoverEnv, make_env):
            env = make(world_n=options.world, num_envs=count, lidar_beams=options.beams, seed=0)
            rows.append(measure(env, options.seconds, watches))
            env.close()
    show(rows, options)
    if options.json is not None:
        options.json.write_text(json.dumps([asdict(row) for row in rows], indent=2) + "\n")


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
