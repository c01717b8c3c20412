"""The kernels with other block sizes, and with other numbers of lidar threads per rover."""

from __future__ import annotations

from typing import Any

import torch
from rich.table import Table

from benchmarks.gpu.speed import MANY_ROVERS, driving
from benchmarks.gpu.timing import timed
from benchmarks.options import Options
from rover_rl.sims.warp import WarpSettings
from rover_rl.sims.warp.simulator import GPU_BLOCK_SIZE, GPU_LIDAR_LANES

BLOCK_SIZES = (32, 64, 128, 256)
"""Threads per block."""
LANES = (1, 2, 4, 8, 16, 32)
"""Threads that scan for one rover."""
FEW = 8
"""The larger number of rovers is this many times the smaller one."""


def measure(options: Options, device: torch.device, _: dict[str, Any]) -> list[dict[str, Any]]:
    """Measures physics and lidar with each setting, the others at their defaults."""
    settings = [(GPU_BLOCK_SIZE, lanes) for lanes in LANES]
    # Block sizes exist on a GPU only.
    settings += [(size, GPU_LIDAR_LANES) for size in BLOCK_SIZES if size != GPU_BLOCK_SIZE and device.type == "cuda"]
    many = min(MANY_ROVERS, max(options.gpu_rovers))
    sizes = sorted({max(1, many // FEW), many})
    # A level world and a rough one.
    cases = [(world, rovers, min(options.gpu_beams)) for world in options.gpu_worlds[:2] for rovers in sizes]
    return [_case(options, device, *case, *setting) for case in cases for setting in settings]


def _case(
    options: Options, device: torch.device, world: str, rovers: int, beams: int, block_size: int, lanes: int
) -> dict[str, Any]:
    settings = WarpSettings(block_size=block_size, lidar_lanes=lanes)
    with driving(world, rovers, beams, device, settings) as drive:
        rover = drive.env.base_env
        kernels = {"physics": rover.simulator.launch, "lidar": rover.scanner.launch}
        times = {name: timed(work, device, options.gpu_seconds / 2, drive.step) for name, work in kernels.items()}
    rates = {name: rovers / timing.device for name, timing in times.items()}
    return {"world": world, "rovers": rovers, "beams": beams, "block_size": block_size, "lanes": lanes, **rates}


def table(rows: list[dict[str, Any]]) -> Table:
    """Formats the rows for the terminal."""
    headings = "world", "rovers", "beams", "block", "lidar threads per rover", "physics", "lidar"
    table = Table(*headings, title="Rovers/s with other settings")
    for row in rows:
        numbers = (
            row["rovers"],
            row["beams"],
            row["block_size"],
            row["lanes"],
            round(row["physics"]),
            round(row["lidar"]),
        )
        table.add_row(row["world"], *(f"{number:,}" for number in numbers))
    return table
