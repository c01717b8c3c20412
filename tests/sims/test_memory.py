"""Environments take little memory and release it, as a process of its own measures, and print nothing."""

from __future__ import annotations

import gc
import json
import os
import subprocess
import sys
from importlib.util import find_spec
from itertools import count

import numpy as np
import psutil
import pytest
import torch

from rover_rl import RoverEnv, make_env
from rover_rl.native.bullet import disconnect
from rover_rl.worlds import Terrain, World, boulder, box

BACKENDS = ["bullet", "warp", *(["mujoco"] if find_spec("mujoco") else [])]
CYCLES = 2
LIMIT = 5.0 * CYCLES
"""Allowed growth in MB. The lists leaked by PyBullet's own functions take 21 to 115 MB per environment."""
ALLOCATOR = {"MALLOC_MMAP_THRESHOLD_": str(2**14), "MALLOC_TRIM_THRESHOLD_": str(2**16)}
"""Settings of the C library of Linux (glibc), which returns freed memory to the system early. By default it keeps 40 MB
or none of MuJoCo's and Bullet's, depending on the order of the calls."""


def hills(seed: int) -> World:
    """A world with a mesh of the ground, boulders and a box. The built-in ones have nothing that it does not have."""
    rng = np.random.default_rng(seed)
    rocks = [boulder((x, y, 0.2), 0.4, rng) for x in (-3, 3) for y in (-3, 3)]
    solids = [*rocks, box((0, 3, 0.5), (1.0, 0.1, 1.0))]
    return World(
        f"hills {seed}", Terrain(0.002 * rng.standard_normal((181, 181)), 0.05), solids, spawn_range=((-1.5, 1.5),) * 2
    )


def memory() -> float:
    """Resident memory of this process, MB."""
    gc.collect()
    # It returns what is free to the system.
    disconnect(())
    return psutil.Process().memory_info().rss / 1e6


def growth(backend: str) -> float:
    """Twice the difference between the lowest readings in the halves of the measurement.

    A leak raises the lowest reading, while memory that is freed late, some 14 MB in MuJoCo, does not.
    """
    seeds, readings = count(), []
    for _ in range(CYCLES + 2):
        env = make_env(world_n=hills(next(seeds)), num_envs=4, backend=backend, lidar_beams=32)
        env.rollout(3)
        env.render(width=64, height=48)
        env.close()
        readings.append(memory())
    warm, half = readings[1:], len(readings) // 2
    return 2 * (min(warm[half - 1 :]) - min(warm[: half - 1]))


def of_many() -> tuple[float, float]:
    """What many rovers take in Bullet, and by how much their resets grow it, MB."""
    imported = memory()
    env = RoverEnv(world_n="inspect", num_envs=128, seed=0, backend="bullet")
    env.step(env.reset().set("action", torch.zeros(128, 2)))
    peak = memory() - imported
    for _ in range(3):
        env.reset()
    warm = memory()
    for _ in range(12):
        env.reset()
    grown = memory() - warm
    env.close()
    return peak, grown


@pytest.mark.slow
def test_environments_take_little_memory_release_it_and_print_nothing() -> None:
    command = [sys.executable, "-m", "tests.sims.test_memory"]
    done = subprocess.run(command, capture_output=True, text=True, check=True, env=os.environ | ALLOCATOR)
    (peak, grown), *grown_by = json.loads(done.stdout)
    assert "pybullet" not in done.stderr
    # PyTorch alone takes 420 MB besides, and the build for CUDA 700.
    assert peak < 300
    # 1,536 resets: a leak of one kilobyte per reset would add 1.5 MB.
    assert grown < 1
    assert max(grown_by) < LIMIT, dict(zip(BACKENDS, grown_by, strict=True))


if __name__ == "__main__":
    torch.set_num_threads(1)
    print(json.dumps([of_many(), *(growth(backend) for backend in BACKENDS)]))
