"""Opens and closes environments, for test_leaks.py: in a process of its own, whose memory nothing else changes."""

from __future__ import annotations

import gc
from itertools import count

import numpy as np
import psutil
import torch

from rover_rl import make_env
from rover_rl.sims.worlds import Terrain, World, boulder

WARMUP, CYCLES = 2, 4
"""Environments that are opened and closed before the memory is first read, and until it is read again."""

WORLDS = ("inspect", "moon", "maze", "new")
"""The package's worlds, and one that is made anew for each environment."""


def growth(backend: str) -> dict[str, float]:
    """Megabytes by which the process grows over :data:`CYCLES` environments in each of :data:`WORLDS`."""
    torch.set_num_threads(1)
    return {name: _growth(name, backend) for name in WORLDS}


def _growth(name: str, backend: str) -> float:
    seeds = count()
    for _ in range(WARMUP):
        _open_and_close(name, backend, next(seeds))
    before = _memory()
    for _ in range(CYCLES):
        _open_and_close(name, backend, next(seeds))
    return _memory() - before


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
    return World(f"hills {seed}", Terrain(heights, 0.05), rocks, spawn_range=area)


def _memory() -> float:
    """Memory of this process, MB."""
    gc.collect()
    return psutil.Process().memory_info().rss / 1e6
