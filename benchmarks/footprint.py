"""Startup time and memory of environments."""

from __future__ import annotations

import multiprocessing
import time
from concurrent.futures import ProcessPoolExecutor
from typing import Any

import psutil
import torch
from rich.table import Table

from benchmarks.options import Options
from benchmarks.told import told

MEGABYTE = 2**20


def start(world: str, rovers: int) -> dict[str, Any]:
    """Creates and resets an environment, and returns its startup time and memory. Needs a fresh process.

    The time to import the package is a separate entry.
    """
    begin = time.perf_counter()
    from rover_rl import make_env

    imported = time.perf_counter()
    torch.set_num_threads(1)
    before = psutil.Process().memory_info().rss
    env = make_env(world_n=world, num_envs=rovers, seed=0)
    env.reset()
    ready = time.perf_counter()
    after = psutil.Process().memory_info().rss
    env.close()
    return {
        "rovers": rovers,
        "import_s": imported - begin,
        "start_s": ready - imported,
        "megabytes": (after - before) / MEGABYTE,
    }


def measure(options: Options) -> list[dict[str, Any]]:
    """Measures each number of rovers in a separate process. Returns a row for each."""
    rows = []
    for rovers in options.num_envs:
        with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
            started = pool.submit(start, options.world, rovers)
            rows.append(told(f"start of {rovers:,} rovers", started.result))
    return rows


def table(rows: list[dict[str, Any]]) -> Table:
    """Formats the rows for the terminal."""
    table = Table("rovers", "import s", "start s", "MB", "MB per further rover", title="Startup time and memory")
    first = rows[0]
    for row in rows:
        further = row["rovers"] - first["rovers"]
        each = f"{(row['megabytes'] - first['megabytes']) / further:.2f}" if further > 0 else ""
        table.add_row(
            str(row["rovers"]), f"{row['import_s']:.1f}", f"{row['start_s']:.1f}", f"{row['megabytes']:.0f}", each
        )
    return table
