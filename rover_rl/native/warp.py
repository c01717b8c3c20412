"""Import and configuration of NVIDIA Warp; raises a clear error if it is not installed."""

from __future__ import annotations

from concurrent.futures import Future, ThreadPoolExecutor
from functools import cache
from typing import TYPE_CHECKING, Any

from rover_rl.native.output import native_output_silenced

if TYPE_CHECKING:
    import torch

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

_LOADER = ThreadPoolExecutor(1, thread_name_prefix="kernels")
"""Warp compiles its headers again in each thread that compiles kernels, which takes longer than most kernels."""

__all__ = ["launch_options", "loading", "stream_of", "wp"]


@cache
def loading(device: str, block_size: int | None, *modules: Any) -> Future[None]:
    """Begins to load modules of kernels, one after the other, after those that were asked for before."""
    return _LOADER.submit(wp.force_load, device, [*modules], block_size, max_workers=0)


def stream_of(device: torch.device) -> Any:
    """Returns Torch's current stream, which orders kernels and tensor operations; ``None`` on the CPU."""
    return wp.stream_from_torch(device) if device.type == "cuda" else None


def launch_options(device: torch.device) -> dict[str, Any]:
    """Returns keyword arguments of ``wp.launch`` for kernels with a thread per row, each of which has much to do.

    Small blocks spread few rows over all multiprocessors of a GPU.
    """
    options: dict[str, Any] = {"device": wp.device_from_torch(device)}
    return options if device.type != "cuda" else {**options, "stream": stream_of(device), "block_dim": BLOCK_SIZE}
