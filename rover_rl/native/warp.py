"""Import and configuration of NVIDIA Warp; raises a clear error if it is not installed."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from functools import cache, partial
from itertools import pairwise
from typing import Any

import torch

from rover_rl.native.output import native_output_silenced
from rover_rl.native.threads import kernel_threads

try:
    import warp as wp
except ImportError as error:
    raise ImportError("pictures and backend='warp' need NVIDIA Warp: pip install warp-lang") from error

wp.config.log_level = wp.LOG_ERROR
# No kernel is differentiated, and adjoint kernels take a minute to compile.
wp.config.enable_backward = False
# Warp prints a warning on machines without a GPU.
with native_output_silenced():
    wp.init()

BLOCK_SIZE = 32
"""Threads per block on a GPU of kernels whose threads have much to do."""

MIN_ROWS = 64
"""Minimum number of rows per CPU thread of a launch; with fewer, another thread does not pay."""

__all__ = ["BLOCK_SIZE", "launch_options", "launch_rows", "loading", "run_together", "shares_of", "stream_of", "wp"]


@cache
def loading(*jobs: tuple[str, int | None, tuple[Any, ...]]) -> list[Future[None]]:
    """Begins to load modules of kernels, each job on a device and with a block size, one after the other.

    Warp compiles its headers again in each thread, which takes longer than most kernels: so there is one for all.
    """
    loader = ThreadPoolExecutor(1)
    return [loader.submit(wp.force_load, device, [*modules], size, max_workers=0) for device, size, modules in jobs]


def stream_of(device: torch.device) -> Any:
    """Returns Torch's current stream, which orders kernels and tensor operations; ``None`` on the CPU."""
    return wp.stream_from_torch(device) if device.type == "cuda" else None


def launch_options(device: torch.device) -> dict[str, Any]:
    """Returns keyword arguments of ``wp.launch`` for kernels with a thread per row, each of which has much to do.

    Small blocks spread few rows over all multiprocessors of a GPU.
    """
    options: dict[str, Any] = {"device": wp.device_from_torch(device)}
    return options if device.type != "cuda" else {**options, "stream": stream_of(device), "block_dim": BLOCK_SIZE}


def launch_rows(
    kernel: Any,
    shape: Sequence[int],
    inputs: Sequence[Any],
    device: torch.device,
    least: int = MIN_ROWS,
    block_dim: int | None = None,
) -> None:
    """Launches a kernel, on the CPU in several threads, for at least so many rows each.

    The kernel's last argument, after ``inputs``, is the first row. ``block_dim`` are threads per block on a GPU.
    """
    blocks = {"block_dim": block_dim} if block_dim and device.type == "cuda" else {}
    launch = partial(wp.launch, kernel, device=wp.device_from_torch(device), stream=stream_of(device), **blocks)
    # Else, each thread would compile the kernel.
    loading((str(wp.device_from_torch(device)), blocks.get("block_dim"), (kernel.module,)))[0].result()
    shares = shares_of(shape[0], device, least)
    run_together([partial(launch, (last - first, *shape[1:]), [*inputs, first]) for first, last in shares])


def shares_of(rows: int, device: torch.device, least: int) -> list[tuple[int, int]]:
    """Returns the first row and the end of each CPU thread's share of rows, of at least so many each."""
    threads = max(1, min(kernel_threads(), rows // least)) if device.type == "cpu" else 1
    return [*pairwise(rows * k // threads for k in range(threads + 1))]


def run_together(jobs: Sequence[Callable[[], object]]) -> None:
    """Runs jobs, each but the first in a thread of its own, and waits for them."""
    begun = [_threads(len(jobs), os.getpid()).submit(job) for job in jobs[1:]]
    jobs[0]()
    for job in begun:
        job.result()


@cache
def _threads(count: int, process: int) -> ThreadPoolExecutor:
    """Threads of this process: a fork has none of them."""
    return ThreadPoolExecutor(count)
