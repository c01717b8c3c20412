"""Cores of this machine, and how many workers use them. Imports no PyTorch."""

from __future__ import annotations

import os


def default_workers(num_envs: int, cores: int | None = None) -> int:
    most = max(1, min(usable_cores() if cores is None else cores, num_envs))
    return next(workers for workers in range(most, 0, -1) if num_envs % workers == 0)


def usable_cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
