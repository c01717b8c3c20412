"""Resources of the Warp kernels on a GPU, without one: registers, local memory and resident threads.

    pip install nvidia-cuda-nvcc
    python -m benchmarks.gpu.kernel_resources --arch 90

Compiles the kernels of the package to PTX and assembles them with NVIDIA's ``ptxas``. The table lists for each kernel
the registers of a thread, its stack frame and spilled registers in local memory (bytes), the threads that are resident
on a multiprocessor in blocks of 32, and how many rovers that is on 132 multiprocessors (H100, H200).
"""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import tyro
from rich.console import Console
from rich.table import Table

from rover_rl.native.warp import wp
from rover_rl.sims.warp.simulator import GPU_LIDAR_LANES

MODULES = (
    "rover_rl.sims.warp.kernels.dynamics",
    "rover_rl.sims.warp.kernels.lidar",
    "rover_rl.sims.warp.kernels.placing",
    "rover_rl.sims.scenes.ray_kernels",
    "rover_rl.envs.seen_map.scan_kernels",
    "rover_rl.envs.seen_map.route_kernels",
    "rover_rl.envs.mover_tracker_kernels",
)
REGISTERS, WARPS, PARTITIONS = 16384, 8, 4
"""Registers of a partition of a multiprocessor, its warps with blocks of one warp, and the number of partitions
(compute capability 9.0). A warp takes registers in groups of 256, from one partition."""
MULTIPROCESSORS = 132
LANES = {"scan": GPU_LIDAR_LANES}  # threads per rover of the kernels in which several share one
ENTRY = re.compile(
    r"entry function '(\w+?)_[0-9a-f]{8}_\w+'.*?(\d+) bytes stack frame, (\d+) bytes spill stores"
    r".*?Used (\d+) registers",
    re.DOTALL,
)


def resident_threads(registers: int) -> int:
    """How many threads of so many registers fit on a multiprocessor (compute capability 9.0), in blocks of a warp."""
    per_warp = -(-registers * 32 // 256) * 256
    return 32 * PARTITIONS * min(REGISTERS // per_warp, WARPS)


class Resources(NamedTuple):
    """What a kernel needs: bytes of stack frame and of spilled registers, and registers, all per thread."""

    kernel: str
    stack: int
    spilled: int
    registers: int


@dataclass(frozen=True)
class Options:
    """Print the resources of the Warp kernels on a GPU, without one."""

    arch: int = 90
    """Compute capability times ten; the resident threads are those of 9.0."""


def find_ptxas() -> str:
    wheels = (path for folder in sys.path for path in Path(folder or ".").glob("nvidia/*/bin/ptxas"))
    found = next(map(str, wheels), None) or shutil.which("ptxas")
    if found is None:
        raise SystemExit("error: needs NVIDIA's ptxas: pip install nvidia-cuda-nvcc")
    return found


def resources(module: str, arch: int, ptxas: str) -> Iterator[Resources]:
    """Compiles the kernels of a module and yields what each needs.

    Raises ``SystemExit`` if ``ptxas`` fails, as one that is older than Warp's compiler does.
    """
    with TemporaryDirectory() as folder:
        wp.compile_aot_module(import_module(module), arch=arch, module_dir=folder, use_ptx=True)
        (ptx,) = Path(folder).glob("*.ptx")
        # Warp ends the text with a zero byte, which ptxas rejects.
        ptx.write_bytes(ptx.read_bytes().rstrip(b"\0"))
        command = [ptxas, f"-arch=sm_{arch}", "-v", str(ptx), "-o", str(ptx.with_suffix(".cubin"))]
        report = subprocess.run(command, capture_output=True, text=True)
    if report.returncode:
        line = next(iter(report.stderr.splitlines()), "no message").split("; ")[-1]
        raise SystemExit(f"error: {ptxas} failed, a newer one may be needed (pip install -U nvidia-cuda-nvcc): {line}")
    for name, *numbers in ENTRY.findall(report.stderr):
        yield Resources(name, *map(int, numbers))


def main(options: Options) -> None:
    ptxas = find_ptxas()
    headings = "kernel", "registers", "stack, bytes", "spilled, bytes", "resident threads", "resident rovers, 132 SMs"
    table = Table(*headings, title=f"Warp kernels on sm_{options.arch}")
    for module in MODULES:
        for each in resources(module, options.arch, ptxas):
            resident = resident_threads(each.registers)
            rovers = resident * MULTIPROCESSORS // LANES.get(each.kernel, 1)
            numbers = each.registers, each.stack, each.spilled, resident, rovers
            table.add_row(each.kernel, *(f"{number:,}" for number in numbers))
    Console(width=max(120, Console().width)).print(table)


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
