"""What ``python -m benchmarks`` is asked for."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Options:
    """What to measure, and how long."""

    world: str = "inspect"
    """World, by name."""
    num_envs: tuple[int, ...] = (1, 16, 64, 256, 1024)
    """Numbers of rovers."""
    beams: tuple[int, ...] = (32, 128, 640)
    """Lidar beams of a rover."""
    rovers: int = 64
    """Rovers where their number is not what is varied."""
    warp_rovers: int = 512
    """Rovers of Warp's simulator beside Bullet's, which has ``rovers``."""
    warp_envs: int = 4096
    """Rovers of Warp's whole environment."""
    endurance: int = 10_000_000
    """Random steps that Warp is to hold for."""
    workers: int = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    """Processes where all cores are used."""
    processes: tuple[int, ...] = ()
    """Processes of peers, with a rover each; by default as many as rovers, and four a core."""
    seconds: float = 4.0
    """About how long each thing is measured, each time."""
    rounds: int = 5
    """Times that two things are measured in turn, where their ratio is wanted; the median counts."""
    minutes: float = 1.0
    """Wall clock of each training."""
    out: Path = Path("runs/bench")
    """Folder to write to."""

    def __post_init__(self) -> None:
        for name in ("rovers", "warp_rovers", "warp_envs", "workers", "rounds"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, got {getattr(self, name)}")
        if not self.num_envs or min(self.num_envs) < 1:
            raise ValueError(f"num_envs must name numbers of at least 1, got {self.num_envs}")
        if not self.beams or min(self.beams) < 32:
            raise ValueError(f"beams must be at least the 32 lidar points, got {self.beams}")
        if self.rovers % self.workers:
            raise ValueError(f"rovers={self.rovers} cannot be shared equally by workers={self.workers}")
