"""Watchdog: a separate process that stops the rover when the process that drives it dies or hangs.

:class:`Watchdog` runs in the driving process. It starts this module as a program, which reads heartbeats from its
standard input. Without heartbeats, the program sends stop commands: until the next heartbeat, or for a limited time if
the driving process is gone. It also stops the rover for good when it is told to.
"""

from __future__ import annotations

import contextlib
import os
import select
import subprocess
import sys
import time

from rover_rl.sims.ros2.settings import Command, Ros2Settings, TransportName
from rover_rl.sims.ros2.transport import CommandPublisher, make_transport

READY = b"ready\n"
"""Output of the watchdog process once it is ready."""
HEARTBEAT = b"."
"""Input that reports that the driving process is alive."""
HALT = b"h"
"""Input after which the process sends stop commands for good, whatever the driving process does."""
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

    The process sends stop commands on ``topic`` after ``timeout`` (s) without a heartbeat. Entering raises
    ``ChildProcessError`` if it does not start.
    """

    def __init__(self, topic: str, settings: Ros2Settings, timeout: float = 0.5) -> None:
        arguments = [topic, settings.command, settings.transport, settings.frame_id, str(timeout)]
        program = [sys.executable, "-m", "rover_rl.sims.ros2.watchdog", *arguments]
        # A new session, so that Ctrl-C does not end the watchdog before the driving process.
        self._process = subprocess.Popen(program, stdin=subprocess.PIPE, stdout=subprocess.PIPE, start_new_session=True)
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._input, self._output = self._process.stdin, self._process.stdout
        # A full pipe means that the watchdog hangs. It must not block the driving process.
        os.set_blocking(self._input.fileno(), False)

    def __enter__(self) -> Watchdog:
        ready, _, _ = select.select([self._output], [], [], START_TIMEOUT)
        if not ready or self._output.readline() != READY:
            self.close()
            raise ChildProcessError("the watchdog did not start, so the rover is not driven")
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def alive(self) -> None:
        """Sends a heartbeat. Call it at every step. Raises ``ChildProcessError`` if the process is gone or hangs."""
        self._send(HEARTBEAT)

    def halt(self) -> None:
        """Stops the rover for good: the process sends stop commands until :meth:`close`. Any thread may call it."""
        self._send(HALT)

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
        self._input.close()
        self._output.close()

    def _send(self, data: bytes) -> None:
        try:
            os.write(self._input.fileno(), data)
        except (OSError, ValueError) as error:
            raise ChildProcessError("the watchdog is gone, so the rover is no longer driven") from error


def watch(topic: str, command: Command, name: TransportName, frame_id: str, timeout: float) -> None:
    """Reads heartbeats from standard input, and stops the rover ``timeout`` (s) after the last one.

    Runs until the driving process ends. The other arguments are those of the rover's commands.
    """
    transport = make_transport(name, "rover_rl_watchdog")
    commands = CommandPublisher(transport, topic, command, frame_id)
    deadline = time.monotonic() + DISCOVERY_TIMEOUT
    while not transport.subscribers(topic) and time.monotonic() < deadline:
        time.sleep(STOP_INTERVAL)
    sys.stdout.buffer.write(READY)
    sys.stdout.buffer.flush()
    patience: float | None = None  # before the first heartbeat there is nothing to stop
    halted = False
    while True:
        ready, _, _ = select.select([sys.stdin], [], [], patience)
        if not ready:
            commands.stop()
            patience = STOP_INTERVAL
            continue
        received = os.read(sys.stdin.fileno(), 4096)
        if not received:  # the driving process is gone
            for _ in range(round(STOP_DURATION / STOP_INTERVAL)):
                commands.stop()
                time.sleep(STOP_INTERVAL)
        if not received or QUIT in received:
            break
        if halted := halted or HALT in received:
            commands.stop()
        patience = STOP_INTERVAL if halted else timeout
    transport.close()


if __name__ == "__main__":
    watch(sys.argv[1], sys.argv[2], sys.argv[3], sys.argv[4], float(sys.argv[5]))  # type: ignore[arg-type]
