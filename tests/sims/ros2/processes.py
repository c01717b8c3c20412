"""Processes for tests, and waiting for what they do."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Callable


def until(holds: Callable[[], object], seconds: float = 40.0) -> None:
    """Waits until something holds."""
    end = time.monotonic() + seconds
    while not holds():
        assert time.monotonic() < end, "it did not come about in time"
        time.sleep(0.01)


COMMAND = (sys.executable, "-c", "import sys; from rover_rl.cli import main; sys.exit(main())")


def start(environment: dict[str, str], *arguments: str) -> subprocess.Popen[str]:
    """``rover-rl`` with these arguments; what it says is in ``stdout``."""
    command = [*COMMAND, *arguments]
    return subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)


def start_robot(environment: dict[str, str], *arguments: str) -> subprocess.Popen[str]:
    """``rover-rl robot``, which is up."""
    command = [*COMMAND, "robot", "--lidar-beams", "128", *arguments]
    # Its errors go to the test's: in a pipe that nobody reads, many of them would hold it up.
    robot = subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True)
    assert robot.stdout is not None
    assert "on ROS 2" in robot.stdout.readline()
    return robot
