"""What rovers cost before they drive: memory and time to start."""

from __future__ import annotations

import multiprocessing
import time
from concurrent.futures import ProcessPoolExecutor
from typing import Any

import psutil
import torch
from rich.table import Table

from benchmarks.options import Options

MEGABYTE = 2**20


def start(world: str, rovers: int) -> dict[str, Any]:
    """Starts rovers in this process, which should be a fresh one; the import of the package is told apart."""
    begin = time.perf_counter()
    from rover_rl import make_env

    imported = time.perf_counter()
    torch.set_num_threads(1)
    before = psutil.Process().memory_info().rss
    env = make_env(world_n=world, num_envs=rovers, seed=0)
    env.reset()
    made = time.perf_counter()
    after = psutil.Process().memory_info().rss
    env.close()
    return {
        "rovers": rovers,
        "import_s": imported - begin,
        "start_s": made - imported,
        "megabytes": (after - before) / MEGABYTE,
    }


def measure(options: Options) -> list[dict[str, Any]]:
    """A row a number of rovers, each in a process of its own."""
    rows = []
    for rovers in options.num_envs:
        with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
            rows.append(pool.submit(start, options.world, rovers).result())
    return rows


def table(rows: list[dict[str, Any]]) -> Table:
    """For the terminal."""
    table = Table("rovers", "import s", "start s", "MB", "MB a further rover", title="Start and memory")
    first = rows[0]
    for row in rows:
        further = row["rovers"] - first["rovers"]
        each = f"{(row['megabytes'] - first['megabytes']) / further:.2f}" if further > 0 else ""
        table.add_row(
            str(row["rovers"]), f"{row['import_s']:.1f}", f"{row['start_s']:.1f}", f"{row['megabytes']:.0f}", each
        )
    return table
