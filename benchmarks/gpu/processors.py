"""The environment on all cores of the machine's CPU, beside the GPU."""

from __future__ import annotations

import os
from dataclasses import replace
from typing import Any

import torch
from rich.table import Table

from benchmarks.options import Options
from benchmarks.ratios import rate
from benchmarks.simulators import environment_work
from rover_rl import make_env
from rover_rl.sims.warp import WarpSettings


def measure(options: Options, _: torch.device, results: dict[str, Any]) -> list[dict[str, Any]]:
    """Measures Warp on the CPU, and how much faster the fastest row of the GPU is."""
    world, rovers, threads = options.gpu_worlds[0], options.warp_envs, os.cpu_count() or 1
    settings = replace(WarpSettings(), threads=threads)
    rows = []
    for beams in options.gpu_beams:
        env = make_env(world_n=world, num_envs=rovers, lidar_beams=beams, backend=settings, seed=0, device="cpu")
        measured = rate(environment_work(env), 4 * options.gpu_seconds)
        env.close()
        speedup = _fastest(results["speed"], world, beams) / measured
        rows.append(
            {"beams": beams, "rovers": rovers, "threads": threads, "environment": measured, "gpu_speedup": speedup}
        )
    return rows


def _fastest(rows: Any, world: str, beams: int) -> float:
    """Largest number of steps per second of the environment on the GPU; nan if there is none."""
    if not isinstance(rows, list):
        return float("nan")
    same = (row for row in rows if row["beams"] == beams and row["world"] == world)
    return max((row["environment"] for row in same if "error" not in row), default=float("nan"))


def table(rows: list[dict[str, Any]]) -> Table:
    """Formats the rows for the terminal."""
    table = Table("beams", "rovers", "threads", "environment, steps/s", "GPU / CPU", title="CPU of this machine")
    for row in rows:
        table.add_row(
            str(row["beams"]),
            f"{row['rovers']:,}",
            str(row["threads"]),
            f"{row['environment']:,.0f}",
            f"{row['gpu_speedup']:.1f}",
        )
    return table
