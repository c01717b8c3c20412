"""Cost of movers: steps per second of environments with movers, compared with those of the same without.

    python -m benchmarks.movers

Cylinders with a radius of 0.3 m move back and forth through a yard of 20 x 20 m, and rovers drive at random among
them. All environments of a simulator are measured alternately, in processor time, so that other load affects them
alike. The table shows the median of the ratios to the environment without movers.
"""

from __future__ import annotations

import statistics
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro
from rich.console import Console
from rich.table import Table

from rover_rl import RoverEnv
from rover_rl.files import write_json
from rover_rl.worlds import Terrain, World
from rover_rl.worlds.movers import Cylinder, Mover, Waypoints

SIDE = 20.0
"""Side of the yard, m."""


@dataclass
class Options:
    """Measure the cost of movers."""

    backends: tuple[str, ...] = ("bullet", "mujoco", "warp")
    """Simulators."""
    movers: tuple[int, ...] = (1, 8, 24)
    """Numbers of movers."""
    rows: int = 16
    """Number of rovers in Bullet and MuJoCo."""
    warp_rows: int = 4096
    """Number of rovers in Warp."""
    steps: int = 20
    """Number of steps of a measurement."""
    rounds: int = 7
    """Number of alternating measurements."""
    out: Path = Path("runs/movers")
    """Output folder."""


def yard(count: int) -> World:
    """A yard with walkers, each on a straight way of its own."""
    generator = np.random.default_rng(count)
    movers = []
    for _ in range(count):
        (x, y), (u, v) = generator.uniform(-SIDE / 2 + 1, SIDE / 2 - 1, (2, 2))
        yaw, seconds = np.arctan2(v - y, u - x), np.hypot(u - x, v - y) / generator.uniform(0.5, 1.5)
        motion = Waypoints([(0, x, y, yaw), (seconds, u, v, yaw)], repeat="back_and_forth", random_start=True)
        movers.append(Mover(motion, Cylinder(0.3, 1.5)))
    return World(f"yard with {count} movers", Terrain.flat((SIDE, SIDE)), movers=movers)


def measure(backend: str, options: Options) -> dict[str, float]:
    """Returns the steps per second without movers, and the ratio to it for each number of movers."""
    rows = options.warp_rows if backend == "warp" else options.rows
    envs = {
        count: RoverEnv(world_n=yard(count), num_envs=rows, backend=backend, seed=0, length=10_000)
        for count in (0, *options.movers)
    }
    rates: dict[int, list[float]] = {count: [] for count in envs}
    for env in envs.values():
        env.reset()
        _drive(env, 3)
    for _ in range(options.rounds):
        for count, env in envs.items():
            rates[count].append(rows * options.steps / _drive(env, options.steps))
    for env in envs.values():
        env.close()
    ratios = {
        str(count): statistics.median(own / none for own, none in zip(rates[count], rates[0], strict=True))
        for count in options.movers
    }
    return {"steps/s without movers": statistics.median(rates[0]), **ratios}


def _drive(env: RoverEnv, steps: int) -> float:
    """Takes random steps. Returns the processor time, s."""
    tensordict = env.rand_action()
    begin = time.process_time()
    for _ in range(steps):
        env.step(env.rand_action(tensordict))
    return time.process_time() - begin


def main(options: Options) -> dict[str, Any]:
    """Measures all simulators, writes the results and prints a table."""
    torch.set_num_threads(1)
    table = Table("simulator", "rovers", "steps/s without movers", *(f"{count} movers" for count in options.movers))
    results = {}
    for backend in options.backends:
        results[backend] = found = measure(backend, options)
        rate, *ratios = found.values()
        rows = options.warp_rows if backend == "warp" else options.rows
        table.add_row(backend, str(rows), f"{rate:,.0f}", *(f"{ratio:.2f} x" for ratio in ratios))
    write_json(options.out / "movers.json", results)
    Console(width=120).print(table)
    return results


if __name__ == "__main__":
    main(tyro.cli(Options))
