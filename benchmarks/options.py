"""Options of ``python -m benchmarks``."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Options:
    """Options of the benchmarks. Raises ``ValueError`` for a number out of range."""

    world: str = "inspect"
    """Name of the world."""
    num_envs: tuple[int, ...] = (1, 16, 64, 256, 1024)
    """Numbers of rovers."""
    beams: tuple[int, ...] = (32, 128, 640)
    """Numbers of lidar beams per rover."""
    engines: tuple[str, ...] = ()
    """Simulators that ``law``, ``parity`` and ``simulators`` compare. Default: all that are installed."""
    rovers: int = 64
    """Number of rovers in benchmarks that do not vary it."""
    warp_rovers: int = 512
    """Number of rovers for Warp's simulator. Bullet has ``rovers``."""
    warp_envs: int = 4096
    """Number of rovers for environments with Warp."""
    workers: int = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    """Number of worker processes."""
    processes: tuple[int, ...] = ()
    """Numbers of processes in the benchmark of peers, one rover each. Default: ``rovers``, and four per worker."""
    seconds: float = 4.0
    """Approximate duration of each measurement, s."""
    rounds: int = 5
    """Number of alternating measurements for a ratio, whose median is reported."""
    minutes: float = 1.0
    """Duration of each training in minutes."""
    device: str | None = None
    """Device of the benchmark ``gpu``; ``cpu`` rehearses it. Default: the GPU, if there is one."""
    gpu_seconds: float = 0.5
    """Approximate duration of each measurement on the GPU, s."""
    gpu_rovers: tuple[int, ...] = (1024, 4096, 16_384, 65_536, 131_072)
    """Numbers of rovers on the GPU."""
    gpu_beams: tuple[int, ...] = (128, 640)
    """Numbers of lidar beams per rover on the GPU."""
    gpu_worlds: tuple[str, ...] = ("maze", "moon", "inspect", "maze:0-1023")
    """Worlds on the GPU. All numbers of rovers are measured in the first one only."""
    gpu_learners: tuple[int, ...] = (4096, 16_384, 65_536)
    """Numbers of rovers in training on the GPU."""
    out: Path = Path("runs/bench")
    """Output folder."""

    def __post_init__(self) -> None:
        for name in ("rovers", "warp_rovers", "warp_envs", "workers", "rounds"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, got {getattr(self, name)}")
        if not self.num_envs or min(self.num_envs) < 1:
            raise ValueError(f"num_envs must name numbers of at least 1, got {self.num_envs}")
        for name in ("beams", "gpu_beams"):
            if not getattr(self, name) or min(getattr(self, name)) < 32:
                raise ValueError(f"{name} must be at least the 32 lidar points, got {getattr(self, name)}")
        for name in ("gpu_rovers", "gpu_learners"):
            if not getattr(self, name) or min(getattr(self, name)) < 1:
                raise ValueError(f"{name} must name numbers of at least 1, got {getattr(self, name)}")
        if not self.gpu_worlds:
            raise ValueError("gpu_worlds must name at least one world, got none")
        if self.rovers % self.workers:
            raise ValueError(f"rovers={self.rovers} cannot be shared equally by workers={self.workers}")
