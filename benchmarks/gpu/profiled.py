"""Launches each kernel once, with rovers in motion: the program that Nsight Compute profiles.

ncu --profile-from-start no python -m benchmarks.gpu.profiled --rovers 65536
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
import tyro

from benchmarks.gpu.speed import Drive, driving
from rover_rl.envs.seen_map.seen_map import SeenMap

SEEN = 10  # number of scans in the maps before the profiled one
MAPS = 8192  # number of rovers with a map, at most: Nsight Compute stores what a kernel writes before each of its runs


@dataclass
class Options:
    world: str = "maze"
    rovers: int = 65_536
    beams: int = 128
    device: str = "cuda"


def map_work(drive: Drive, device: torch.device, most: int | None = None) -> Callable[[], object]:
    """Returns a function that adds the current scan to the map of each rover, or of the first, and plans its route."""
    rovers = drive.env.base_env
    count = min(rovers.num_envs, most or rovers.num_envs)
    seen = SeenMap(rovers.fleet, rovers.config.lidar)
    return lambda: seen(drive.observation[:count])


def main(options: Options) -> None:
    """Drives the rovers, then launches physics, lidar and map between the marks of the profiler."""
    device = torch.empty(0, device=options.device).device
    with driving(options.world, options.rovers, options.beams, device) as drive:
        add_and_plan = map_work(drive, device, MAPS)
        for _ in range(SEEN):
            drive.step()
            add_and_plan()
        on_gpu = device.type == "cuda"
        if on_gpu:
            torch.cuda.synchronize(device)
            torch.cuda.profiler.start()
        drive.env.base_env.simulator.launch()
        drive.env.base_env.scanner.launch()
        add_and_plan()
        if on_gpu:
            torch.cuda.synchronize(device)
            torch.cuda.profiler.stop()


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
