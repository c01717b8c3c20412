"""Benchmarks: ``python -m benchmarks`` runs all of them, ``python -m benchmarks rollouts peers`` some of them.

- ``rollouts``: steps per second by number of rovers and beams, with one worker and with all, and Bullet's share of the
  time.
- ``simulators``: speed of the simulators compared with Bullet, on one core.
- ``law``: every simulator compared with Coulomb's law of friction by hand.
- ``parity``: agreement of the simulators with one another.
- ``peers``: speed compared with a process and a PyBullet client for each rover.
- ``training``: speed of PPO and SAC compared with Stable-Baselines3.
- ``gpu``: speed on a GPU, skipped without one; see :mod:`benchmarks.gpu`.

Comparisons are measured alternately in one run and reported as ratios, because absolute numbers depend on the machine
and its load. Run nothing else at the same time. Writes ``bench.json`` to ``runs/bench/``.
"""

from __future__ import annotations

import os
import platform
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from typing import Annotated, Any, Literal, get_args

import torch
import tyro
from rich.console import Console

from benchmarks.options import Options
from benchmarks.ratios import told
from rover_rl.files import write_json

Part = Literal["rollouts", "simulators", "law", "parity", "peers", "training", "gpu"]


@dataclass(frozen=True)
class Bench(Options):
    parts: Annotated[tuple[Part, ...], tyro.conf.Positional] = get_args(Part)
    """Benchmarks to run."""


def main(options: Bench) -> dict[str, Any]:
    torch.set_num_threads(1)
    console = Console(width=max(120, Console().width))
    options.out.mkdir(parents=True, exist_ok=True)
    machine = {"processor": platform.processor() or platform.machine(), "cores": os.cpu_count()}
    results: dict[str, Any] = {"machine": machine, "world": options.world}
    for part in options.parts:
        module = import_module(f"benchmarks.{part}")
        results[part] = told(part, partial(module.measure, options))
        console.print(module.table(results[part]))
        write_json(options.out / "bench.json", results)
    return results


if __name__ == "__main__":
    main(tyro.cli(Bench, description=__doc__))
