"""Cores of this machine, how many workers use them, and how they start. Imports no PyTorch."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing import resource_tracker


@contextmanager
def interrupts_held() -> Iterator[None]:
    """Holds Ctrl-C back until the end of the block, and for good from the processes that start in it.

    It would end their imports with a traceback. This process handles it afterwards.
    """
    if threading.current_thread() is not threading.main_thread() or not hasattr(signal, "pthread_sigmask"):
        yield
        return
    resource_tracker.ensure_running()  # whose start lets signals through
    received: list[int] = []
    # Processes inherit the mask. In this one, another thread may get the signal.
    handler = signal.signal(signal.SIGINT, lambda number, frame: received.append(number))
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        signal.signal(signal.SIGINT, handler)
        if received:
            signal.raise_signal(signal.SIGINT)


def default_workers(num_envs: int, cores: int | None = None) -> int:
    most = max(1, min(usable_cores() if cores is None else cores, num_envs))
    return next(workers for workers in range(most, 0, -1) if num_envs % workers == 0)


def usable_cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
