"""Measures this machine: ``python -m benchmarks``, or some of it: ``python -m benchmarks cores peers``.

- ``rollouts``: steps a second against rovers and beams, with one worker and with all, and Bullet's share of the time.
- ``breakdown``: where the rest goes, function by function.
- ``physics``: what each preset costs, and how far it is from steps of 1 ms.
- ``simulators``: Warp's speed beside Bullet's, on a core and, where there is one, on a GPU.
- ``parity``: how far the two are apart.
- ``endurance``: whether Warp holds under ten million random steps.
- ``cores``: all workers beside one.
- ``peers``: the same rover as people drive it today, with a process and a PyBullet client for each.
- ``footprint``: memory and time to start.
- ``training``: PPO and SAC beside Stable-Baselines3's.

What is compared is measured in turn in one run, and told as ratios; no absolute figure of a shared machine says much.
Everything is in ``runs/bench/``: ``bench.json``, ``bench.png``, ``breakdown.html``. Let nothing else run meanwhile.
"""

from __future__ import annotations

import os
import platform
from dataclasses import dataclass
from importlib import import_module
from typing import Annotated, Any, Literal, get_args

import torch
import tyro
from rich.console import Console

from benchmarks.options import Options
from benchmarks.plot import draw
from rover_rl.files import write_json

Part = Literal[
    "rollouts", "breakdown", "physics", "simulators", "parity", "endurance", "cores", "peers", "footprint", "training"
]


@dataclass(frozen=True)
class Bench(Options):
    """What to measure, and how long."""

    parts: Annotated[tuple[Part, ...], tyro.conf.Positional] = get_args(Part)
    """Which parts."""


def main(options: Bench) -> dict[str, Any]:
    """Measures, prints and writes after each part what there is so far."""
    torch.set_num_threads(1)
    console = Console(width=max(120, Console().width))
    options.out.mkdir(parents=True, exist_ok=True)
    machine = {"processor": platform.processor() or platform.machine(), "cores": os.cpu_count()}
    results: dict[str, Any] = {"machine": machine, "world": options.world}
    for part in options.parts:
        module = import_module(f"benchmarks.{part}")
        results[part] = module.measure(options)
        console.print(module.table(results[part]))
        write_json(options.out / "bench.json", results)
    draw(results, options.out / "bench.png")
    return results


if __name__ == "__main__":
    main(tyro.cli(Bench, description=__doc__))
