"""A program of one's own that drives a rover with the backend ``ros2``, in a process of its own."""

from __future__ import annotations

import os
import sys
import time
from pathlib import Path
from typing import Any

from tests.fork_server import fork_server


def start(environment: dict[str, str], report: Path, **options: Any) -> Any:
    """Starts :func:`drive` in a process that has imported the package. Returns the process."""
    process = fork_server().Process(target=_run, args=(environment, report, options), daemon=True)  # type: ignore[attr-defined]
    process.start()
    return process


def _run(environment: dict[str, str], report: Path, options: dict[str, Any]) -> None:
    os.environ.clear()
    os.environ.update(environment)
    drive(report, **options)


def drive(report: Path, steps: int = 10**9, pause: float = 0.0, **settings: Any) -> None:
    """Drives a curve, and pauses for a time (s) after some steps. Appends errors to a file ``report``, and ends."""
    import torch

    from rover_rl import RoverEnv
    from rover_rl.sims.ros2 import Ros2Settings

    print('"up"', flush=True)
    try:
        env = RoverEnv(world_n="maze", backend=Ros2Settings(reset="none", settle=0.05, **settings))
        observation = env.reset()
        for number in range(10**9):
            if number == steps:
                time.sleep(pause)
            step = env.step(observation.set("action", torch.tensor([[0.3, 0.5]])))["next"]
            observation = env.reset() if step["done"].item() else step
    except (OSError, ValueError) as error:
        report.write_text(str(error))


if __name__ == "__main__":
    drive(Path(sys.argv[1]), transport="rclpy")
