"""Watchdog: a separate process that stops the rover when the process that drives it dies or hangs.

:class:`Watchdog` runs in the driving process. It starts this module as a program, which reads heartbeats from its
standard input. Without heartbeats, the program sends stop commands: until the next heartbeat, or for a limited time if
the driving process is gone.
"""

from __future__ import annotations

import contextlib
import os
import select
import subprocess
import sys
import time
from dataclasses import dataclass
from types import TracebackType

import tyro

from rover_rl.sims.ros2.command_publisher import CommandPublisher
from rover_rl.sims.ros2.settings import Command, Ros2Settings, TransportName
from rover_rl.sims.ros2.transport import make_transport

READY = b"ready\n"
"""Output of the watchdog process once it is ready."""
HEARTBEAT = b"."
"""Input that reports that the driving process is alive."""
QUIT = b"q"
"""Input that ends the watchdog process."""
STOP_INTERVAL = 0.05
"""Time between two stop commands, s."""
STOP_DURATION = 2.0
"""Time for which stop commands are sent if the driving process is gone, s."""
DISCOVERY_TIMEOUT = 3.0
"""Time to wait for a subscriber of the commands before the watchdog reports that it is ready, s."""
START_TIMEOUT = 60.0
"""Time limit for the process to start, s."""
EXIT_TIMEOUT = 5.0
"""Time limit for the process to exit, s."""


class Watchdog:
    """Starts and supervises the watchdog process. A context manager, to be entered before the rover moves.

    Args:
        topic: topic of the rover's commands.
        settings: settings of the connection to the rover.
        timeout: time without a heartbeat after which the rover is stopped, s.

    Raises:
        ChildProcessError: if the process does not start.
    """

    def __init__(self, topic: str, settings: Ros2Settings, timeout: float = 0.5) -> None:
        options = {
            "topic": topic,
            "command": settings.command,
            "transport": settings.transport,
            "frame-id": settings.frame_id,
            "timeout": str(timeout),
        }
        arguments = [word for name, value in options.items() for word in (f"--{name}", value)]
        # A new session, so that Ctrl-C does not end the watchdog before the driving process.
        self._process = subprocess.Popen(
            [sys.executable, "-m", "rover_rl.sims.ros2.watchdog", *arguments],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            start_new_session=True,
        )
        assert self._process.stdin is not None
        # A full pipe means that the watchdog hangs. It must not block the driving process.
        os.set_blocking(self._process.stdin.fileno(), False)

    def __enter__(self) -> Watchdog:
        assert self._process.stdout is not None
        ready, _, _ = select.select([self._process.stdout], [], [], START_TIMEOUT)
        if not ready or self._process.stdout.readline() != READY:
            self.close()
            raise ChildProcessError("the watchdog did not start, so the rover is not driven")
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def alive(self) -> None:
        """Sends a heartbeat. Call it at every step.

        Raises:
            ChildProcessError: if the watchdog process is gone or hangs.
        """
        self._send(HEARTBEAT)

    def close(self) -> None:
        """Ends the watchdog process. Idempotent."""
        if self._process.poll() is None:
            with contextlib.suppress(ChildProcessError):
                self._send(QUIT)
            try:
                self._process.wait(EXIT_TIMEOUT)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()
        for pipe in (self._process.stdin, self._process.stdout):
            if pipe is not None:
                pipe.close()

    def _send(self, data: bytes) -> None:
        assert self._process.stdin is not None
        try:
            os.write(self._process.stdin.fileno(), data)
        except (OSError, ValueError) as error:
            raise ChildProcessError("the watchdog is gone, so the rover is no longer driven") from error


@dataclass(frozen=True)
class WatchdogProcess:
    """Read heartbeats from standard input, and stop the rover if they cease."""

    topic: str
    """Topic of the rover's commands."""
    command: Command
    """Message type of the commands."""
    transport: TransportName
    """Transport to publish on."""
    frame_id: str
    """Frame of stamped commands."""
    timeout: float
    """Time without a heartbeat after which the rover is stopped, s."""

    def __call__(self) -> None:
        """Runs until the driving process ends."""
        transport = make_transport(self.transport, "rover_rl_watchdog")
        commands = CommandPublisher(transport, self.topic, self.command, self.frame_id)
        deadline = time.monotonic() + DISCOVERY_TIMEOUT
        while not transport.subscribers(self.topic) and time.monotonic() < deadline:
            time.sleep(STOP_INTERVAL)
        sys.stdout.buffer.write(READY)
        sys.stdout.buffer.flush()
        timeout: float | None = None  # before the first heartbeat there is nothing to stop
        while True:
            received = self._read_input(timeout)
            if received is None:
                commands.stop()
                timeout = STOP_INTERVAL
            elif QUIT in received:
                break
            elif received:
                timeout = self.timeout
            else:
                for _ in range(round(STOP_DURATION / STOP_INTERVAL)):
                    commands.stop()
                    time.sleep(STOP_INTERVAL)
                break
        transport.close()

    @staticmethod
    def _read_input(timeout: float | None) -> bytes | None:
        """Reads standard input: empty if the driving process is gone, ``None`` after ``timeout`` (s) without input."""
        ready, _, _ = select.select([sys.stdin], [], [], timeout)
        return os.read(sys.stdin.fileno(), 4096) if ready else None


if __name__ == "__main__":
    tyro.cli(WatchdogProcess)()
