"""Divergence of the Warp kernels on a GPU, estimated on the CPU.

    python -m benchmarks.divergence

With one thread per rover, the 32 threads of a warp finish together: a warp takes as long as its slowest rover. Times
the kernels for each rover alone on the CPU, after some steps of driving, and prints the mean time divided by the mean
of the longest times in the warps: for the rovers in the order of their rows, sorted by world, by an earlier measurement
and by the measurement itself. The last column bounds what any order of the rows can reach. Noise of the measurement
lowers all of them; threads that take different branches at the same time lower them further on a GPU.
"""

from __future__ import annotations

import time
from dataclasses import dataclass

import torch
import tyro
from rich.console import Console
from rich.table import Table
from torch import Tensor

from rover_rl import RoverEnv, make_env
from rover_rl.sims.warp import WarpSettings

WARP = 32
"""Threads that a GPU runs in lockstep."""


@dataclass(frozen=True)
class Options:
    """Estimate from times on the CPU how well the warps of a GPU are used."""

    worlds: tuple[str, ...] = ("inspect", "moon", "maze", "inspect,moon,maze")
    """Names of the worlds; with several, separated by commas, the rovers take turns."""
    rovers: int = 512
    """Number of rovers, a multiple of 32."""
    beams: int = 128
    """Number of beams of the lidar."""
    steps: int = 60
    """Number of steps that the rovers drive before."""
    repeats: int = 9
    """Number of times that each rover is measured; the least time counts."""


def drive(world: str, options: Options) -> RoverEnv:
    """Returns an environment in which the rovers have driven with random actions."""
    worlds = (world.split(",") * options.rovers)[: options.rovers]
    settings = WarpSettings(threads=1)
    env = make_env(world_n=worlds, num_envs=options.rovers, lidar_beams=options.beams, backend=settings, seed=0)
    td = env.reset()
    random = torch.Generator().manual_seed(0)
    for _ in range(options.steps):
        action = torch.rand(options.rovers, 2, generator=random) * 2 - torch.tensor([0.6, 1.0])
        td = env.step_and_maybe_reset(td.set("action", action))[1]
    return env


def times(env: RoverEnv, physics: bool, repeats: int) -> Tensor:
    """Time of a launch for each rover alone, without that of a launch for no rover, s: ``[N]``."""
    rover = env.base_env
    chosen = rover.simulator._buffers.active if physics else rover.scanner.rows
    work = rover.simulator.launch if physics else rover.scanner.launch

    def launch(row: int | None) -> float:
        if row is not None:
            chosen[row] = True
        begin = time.perf_counter()
        work()
        passed = time.perf_counter() - begin
        chosen.fill_(False)
        return passed

    chosen.fill_(False)
    # Physics moves the rover: every launch simulates a later step. Launches for no rover are in between, so that
    # other load affects both alike.
    found = [(min(launch(row) for _ in range(repeats)), launch(None)) for row in range(len(chosen))]
    works, empty = torch.tensor(found, dtype=torch.float64).T
    return (works - empty.min()).clamp_min(1e-9)


def used(work: Tensor, order: Tensor) -> float:
    """Mean over the mean of the largest of each 32 in a row."""
    return (work.mean() / work[order].view(-1, WARP).amax(1).mean()).item()


def main(options: Options) -> None:
    table = Table("world", "kernel", "us per rover", "by row", "by world", "before", "by time", title="Use of warps")
    for world in options.worlds:
        env = drive(world, options)
        for physics in (True, False):
            before, now = (times(env, physics, options.repeats) for _ in range(2))
            worlds = env.base_env.simulator._buffers.scene.argsort(stable=True)
            orders = torch.arange(len(now)), worlds, before.argsort(), now.argsort()
            shares = (f"{used(now, order):.2f}" for order in orders)
            table.add_row(world, "physics" if physics else "lidar", f"{now.mean() * 1e6:.1f}", *shares)
        env.close()
    Console(width=max(120, Console().width)).print(table)


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
