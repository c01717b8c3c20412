"""Memory leaks of environments.

    python -m benchmarks.leaks

Opens, steps, renders and closes many environments for each world and backend, and prints the growth of the process.
Measures each backend in a fresh process.
"""

from __future__ import annotations

import ctypes
import gc
import sys
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from itertools import count
from multiprocessing import get_context

import numpy as np
import psutil
import torch
import tyro
from rich.console import Console
from rich.table import Table

from rover_rl import make_env
from rover_rl.worlds import Terrain, World, boulder, box

WORLDS = ("inspect", "moon", "maze", "new")  # built-in worlds, and "new" for a world created for each environment


@dataclass
class Options:
    cycles: int = 30
    """Number of environments opened and closed in each world."""
    warmup: int = 5
    """Number of environments opened and closed before the first memory reading."""
    backends: tuple[str, ...] = ("bullet", "warp")
    """Names of the backends."""


def growth(backend: str, cycles: int, warmup: int, worlds: Sequence[str] = WORLDS) -> dict[str, float]:
    """Growth of this process over ``cycles`` environments in each of ``worlds``, MB.

    It is twice the difference between the lowest readings in the halves of the measurement: a leak raises the lowest
    reading, while memory that is freed late, some 14 MB in MuJoCo, does not.
    """
    torch.set_num_threads(1)
    return {name: _growth(name, backend, cycles, warmup) for name in worlds}


def in_fresh_process(backend: str, cycles: int, warmup: int, worlds: Sequence[str] = WORLDS) -> dict[str, float]:
    """Returns :func:`growth`, measured in a fresh process."""
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        return pool.submit(growth, backend, cycles, warmup, worlds).result()


def _growth(name: str, backend: str, cycles: int, warmup: int) -> float:
    seeds = count()
    for _ in range(warmup):
        _open_and_close(name, backend, next(seeds))
    memory = [_memory()]
    for _ in range(cycles):
        _open_and_close(name, backend, next(seeds))
        memory.append(_memory())
    half = len(memory) // 2
    return 2 * (min(memory[half:]) - min(memory[:half]))


def _open_and_close(name: str, backend: str, seed: int) -> None:
    world = _hills(seed) if name == "new" else name
    env = make_env(world_n=world, num_envs=4, backend=backend, lidar_beams=32)
    env.rollout(3)
    env.render(width=64, height=48)
    env.close()


def _hills(seed: int) -> World:
    rng = np.random.default_rng(seed)
    heights = 0.002 * rng.standard_normal((181, 181))
    area = ((-1.5, 1.5), (-1.5, 1.5))
    rocks = [boulder((x, y, 0.2), 0.4, rng) for x in (-3, 3) for y in (-3, 3)]
    panel = box((0, 3, 0.5), (1.0, 0.1, 1.0))
    return World(f"hills {seed}", Terrain(heights, 0.05), [*rocks, panel], spawn_range=area)


def _memory() -> float:
    """Resident memory of this process, MB."""
    gc.collect()
    if sys.platform == "linux":
        # By default, glibc keeps 40 MB of freed memory or none, depending on the order of the calls.
        with suppress(AttributeError):
            ctypes.CDLL(None).malloc_trim(0)
    return psutil.Process().memory_info().rss / 1e6


def main(options: Options) -> None:
    table = Table("backend", *WORLDS, title=f"Growth in MB over {options.cycles} environments")
    for backend in options.backends:
        grown = in_fresh_process(backend, options.cycles, options.warmup)
        table.add_row(backend, *(f"{megabytes:.1f}" for megabytes in grown.values()))
    Console(width=100).print(table)


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
