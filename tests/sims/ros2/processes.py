"""Helpers that start processes and wait for conditions."""

from __future__ import annotations

import os
import sys
import tempfile
import time
from collections.abc import Callable

from tests.fork_server import fork_server


def until(condition: Callable[[], object], seconds: float = 40.0) -> None:
    """Waits until a condition holds, at most for the given time (s)."""
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "the condition does not hold in time"
        time.sleep(0.01)


ROBOT = ("robot", "--lidar-beams", "128")


class Command:
    """``rover-rl`` in a process of its own, forked from a server that has imported the package.

    Args:
        environment: environment variables of the process.
        arguments: arguments of the command line.
    """

    def __init__(self, environment: dict[str, str], *arguments: str) -> None:
        self._output = tempfile.NamedTemporaryFile("r")  # noqa: SIM115
        self._process = fork_server().Process(  # type: ignore[attr-defined]
            target=_run, args=(environment, arguments, self._output.name), daemon=True
        )
        self._process.start()

    @property
    def output(self) -> str:
        """Standard output and errors so far."""
        self._output.seek(0)
        return self._output.read()

    @property
    def running(self) -> bool:
        """Whether the process has not ended yet."""
        return self._process.is_alive()

    def send_signal(self, number: int) -> None:
        """Sends a signal."""
        assert self._process.pid is not None
        os.kill(self._process.pid, number)

    def kill(self) -> None:
        """Kills the process and waits for its end. Does nothing to one that has ended."""
        self._process.kill()
        self._process.join()

    def wait(self, seconds: float) -> int:
        """Waits for the end, at most for the given time (s). Returns the exit code."""
        self._process.join(seconds)
        assert self._process.exitcode is not None, f"the process does not end in time; its output: {self.output}"
        return self._process.exitcode


def _run(environment: dict[str, str], arguments: tuple[str, ...], output: str) -> None:
    """Runs ``rover-rl`` in this process, with its output in a file."""
    from rover_rl.cli import main

    descriptor = os.open(output, os.O_WRONLY | os.O_APPEND)
    os.dup2(descriptor, 1)
    os.dup2(descriptor, 2)
    os.environ.clear()
    os.environ.update(environment)
    sys.exit(main(list(arguments)))


def start_robot(environment: dict[str, str], *arguments: str) -> Command:
    """Starts ``rover-rl robot``, and waits until it is ready."""
    robot = Command(environment, *ROBOT, *arguments)
    until(lambda: "on ROS 2" in robot.output or not robot.running)
    assert robot.running, robot.output
    return robot
