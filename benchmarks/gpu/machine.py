"""The machine, and its measured ceilings: memory bandwidth, float32 arithmetic and the cost of a launch."""

from __future__ import annotations

import os
import platform
from functools import partial
from pathlib import Path
from typing import Any

import tensordict
import torch
import torchrl
from rich.table import Table

from benchmarks.gpu.timing import timed
from benchmarks.options import Options
from rover_rl.native.warp import wp

COPIED_BYTES = {"cuda": 2**32, "cpu": 2**26}  # size of the tensor that is copied, several times that of the cache
MATRIX = {"cuda": 8192, "cpu": 1024}  # rows and columns of the float32 matrices that are multiplied


def measure(options: Options, device: torch.device, _: dict[str, Any]) -> dict[str, Any]:
    """Describes the machine, and measures what its device can do at most."""
    return {
        "gpu": torch.cuda.get_device_name(device) if device.type == "cuda" else None,
        "processor": _processor(),
        "cores": os.cpu_count(),
        "torch": torch.__version__,
        "cuda": torch.version.cuda,
        "torchrl": torchrl.__version__,
        "tensordict": tensordict.__version__,
        "warp": wp.config.version,
        "python": platform.python_version(),
        **(_properties(device) if device.type == "cuda" else {}),
        **_ceilings(options, device),
    }


def _properties(device: torch.device) -> dict[str, Any]:
    found = torch.cuda.get_device_properties(device)
    driver = wp.get_cuda_driver_version()
    return {
        "multiprocessors": found.multi_processor_count,
        "registers": found.regs_per_multiprocessor,
        "threads": found.max_threads_per_multi_processor,
        "memory_bytes": found.total_memory,
        "l2_bytes": found.L2_cache_size,
        "driver_cuda": ".".join(map(str, driver)) if driver else None,
    }


def _ceilings(options: Options, device: torch.device) -> dict[str, float]:
    """Measures bytes and operations per second, and the time of a launch."""
    source = torch.rand(COPIED_BYTES[device.type] // 4, device=device)
    target = torch.empty_like(source)
    copy = timed(partial(target.copy_, source), device, options.gpu_seconds).device
    moved = 2 * source.numel() * source.element_size()
    side = MATRIX[device.type]
    one, other = torch.rand(2, side, side, device=device)
    # Arithmetic of the ordinary units, which the kernels use, and not that of the matrix units.
    with_tf32 = torch.backends.cuda.matmul.allow_tf32
    torch.backends.cuda.matmul.allow_tf32 = False
    try:
        product = timed(lambda: one @ other, device, options.gpu_seconds).device
    finally:
        torch.backends.cuda.matmul.allow_tf32 = with_tf32
    small = torch.zeros(1, device=device)
    return {
        "bytes_per_s": moved / copy,
        "flops_per_s": 2 * side**3 / product,
        "launch_s": timed(lambda: small.add_(1), device, options.gpu_seconds).wall,
    }


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        return next(line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()


def table(found: dict[str, Any]) -> Table:
    table = Table("what", "value", title="Machine")
    units = {"bytes_per_s": (1e-12, "TB/s"), "flops_per_s": (1e-12, "TFLOP/s, float32"), "launch_s": (1e6, "us")}
    for name, value in found.items():
        factor, unit = units.get(name, (None, ""))
        table.add_row(name, f"{value * factor:.3g} {unit}" if factor else str(value))
    return table
