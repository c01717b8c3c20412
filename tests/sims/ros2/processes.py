"""Helpers that start processes and wait for conditions."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Callable


def until(condition: Callable[[], object], seconds: float = 40.0) -> None:
    """Waits until a condition holds, at most for the given time (s)."""
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "the condition does not hold in time"
        time.sleep(0.01)


COMMAND = (sys.executable, "-c", "import sys; from rover_rl.cli import main; sys.exit(main())")


def start(environment: dict[str, str], *arguments: str) -> subprocess.Popen[str]:
    """Starts ``rover-rl`` with arguments; its output and errors go to ``stdout``."""
    command = [*COMMAND, *arguments]
    return subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)


def start_robot(environment: dict[str, str], *arguments: str) -> subprocess.Popen[str]:
    """Starts ``rover-rl robot``, and waits until it is ready."""
    command = [*COMMAND, "robot", "--lidar-beams", "128", *arguments]
    # Standard error is inherited: a full pipe that nobody reads would block the process.
    robot = subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True)
    assert robot.stdout is not None
    assert "on ROS 2" in robot.stdout.readline()
    return robot
