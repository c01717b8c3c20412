"""Watchdog: a separate process that stops the rover when the process that drives it dies or hangs.

:class:`Watchdog` runs in the driving process. It starts :func:`watch` as a program, which reads heartbeats from its
standard input. If they cease while the rover moves, or the driving process is gone, the program sends stop commands for
a limited time, at most until the next heartbeat. It also stops the rover for good when it is told to.
"""

from __future__ import annotations

import contextlib
import math
import os
import select
import signal
import subprocess
import sys
import time

from rover_rl.sims.ros2.settings import Command, Ros2Settings, TransportName
from rover_rl.sims.ros2.transport import CommandPublisher, make_transport

READY = b"ready\n"
"""Output of the watchdog process once it is ready."""
HEARTBEAT = b"."
"""Input that reports that the driving process is alive, and that the rover moves."""
REST = b"r"
"""Input that reports that the rover was stopped, so that there is nothing to watch until the next heartbeat."""
HALT = b"h"
"""Input after which the process sends stop commands for good, whatever the driving process does."""
QUIT = b"q"
"""Input that ends the watchdog process."""
TIMEOUT = 0.3
"""Time without a heartbeat after which the rover is stopped, s."""
STOP_INTERVAL = 0.05
"""Time between two stop commands, s."""
STOP_DURATION = 2.0
"""Time for which stop commands are sent if the driving process is gone or hangs, s."""
STOP_DELAY = 0.5
"""Time after a missing heartbeat within which stop commands may still arrive, s."""
DISCOVERY_TIMEOUT = 3.0
"""Time to wait for a subscriber of the commands before the watchdog reports that it is ready, s."""
START_TIMEOUT = 60.0
"""Time limit for the process to start, s."""
EXIT_TIMEOUT = 5.0
"""Time limit for the process to exit, s."""


class Watchdog:
    """Starts and supervises the watchdog process. As a context manager, it is entered before the rover moves.

    The process sends stop commands on ``topic`` after ``timeout`` (s) without a heartbeat. The first heartbeat, or
    entering, waits until it is ready, and raises ``ChildProcessError`` if it does not start. ``listeners`` is the
    number of subscribers of the topic besides the rover.
    """

    def __init__(self, topic: str, settings: Ros2Settings, timeout: float = TIMEOUT, listeners: int = 0) -> None:
        arguments = topic, settings.command, settings.transport, settings.node, settings.frame_id, timeout, listeners
        program = f"import sys; sys.path[:] = {sys.path!r}; from {__name__} import watch; watch(*{arguments!r})"
        # A new session, so that Ctrl-C does not end the watchdog before the driving process.
        self._process = subprocess.Popen(
            [sys.executable, "-c", program], stdin=subprocess.PIPE, stdout=subprocess.PIPE, start_new_session=True
        )
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._input, self._output = self._process.stdin, self._process.stdout
        # A full pipe means that the watchdog hangs. It must not block the driving process.
        os.set_blocking(self._input.fileno(), False)
        self._timeout, self._is_ready, self._is_halted = timeout, False, False
        self._last, self._missed = math.inf, -math.inf  # times of the last heartbeat, and of one that came late

    def __enter__(self) -> Watchdog:
        ready, _, _ = select.select([self._output], [], [], START_TIMEOUT)
        if not ready or self._output.readline() != READY:
            self.close()
            raise ChildProcessError("the watchdog did not start, so the rover is not driven")
        self._is_ready = True
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def may_be_stopping(self) -> bool:
        """Whether stop commands of the process may arrive."""
        now = time.monotonic()
        return self._is_halted or now - self._missed < STOP_DELAY or now - self._last > 0.8 * self._timeout

    def alive(self) -> None:
        """Sends a heartbeat. Call it with every command that moves the rover, and while it is in force.

        Raises ``ChildProcessError`` if the process is gone or hangs.
        """
        if not self._is_ready:
            self.__enter__()
        if self.may_be_stopping:
            self._missed = time.monotonic()
        self._send(HEARTBEAT)
        self._last = time.monotonic()

    def rest(self) -> None:
        """Reports that the rover was stopped: until the next heartbeat, there is nothing to watch."""
        self._last = math.inf
        with contextlib.suppress(ChildProcessError):  # the next heartbeat reports it
            if self._is_ready:
                self._send(REST)

    def halt(self) -> None:
        """Stops the rover for good: the process sends stop commands until :meth:`close`. Any thread may call it."""
        self._is_halted = True
        self._send(HALT)

    def close(self) -> None:
        """Ends the watchdog process. Idempotent."""
        if self._process.poll() is None:
            with contextlib.suppress(ChildProcessError):
                self._send(QUIT)
            try:
                # A process that is not ready yet has nothing to stop.
                self._process.wait(EXIT_TIMEOUT if self._is_ready else 0.0)
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


def watch(
    topic: str, command: Command, name: TransportName, node: str, frame_id: str, timeout: float, listeners: int
) -> None:
    """Reads heartbeats from standard input, and stops the rover ``timeout`` (s) after the last one.

    Runs until the driving process ends. The other arguments are those of the rover's commands and of the driving node,
    and the number of subscribers of the commands besides the rover.
    """
    for number in (signal.SIGINT, signal.SIGTERM):  # as a service manager sends them to all processes at once
        signal.signal(number, signal.SIG_IGN)
    transport = make_transport(name, f"{node}_watchdog")
    commands = CommandPublisher(transport, topic, command, frame_id)
    deadline, received = time.monotonic() + DISCOVERY_TIMEOUT, False
    while transport.subscribers(topic) <= listeners and time.monotonic() < deadline and not received:
        received = bool(select.select([sys.stdin], [], [], STOP_INTERVAL)[0])
    sys.stdout.buffer.write(READY)
    sys.stdout.buffer.flush()
    patience: float | None = None  # before the first heartbeat there is nothing to stop
    halted, stops = False, 0
    while True:
        ready, _, _ = select.select([sys.stdin], [], [], patience)
        if not ready:
            commands.stop()
            stops += 1
            patience = STOP_INTERVAL if halted or stops * STOP_INTERVAL < STOP_DURATION else None
            continue
        data = os.read(sys.stdin.fileno(), 4096)
        if not data:  # the driving process is gone
            for _ in range(round(STOP_DURATION / STOP_INTERVAL)):
                commands.stop()
                time.sleep(STOP_INTERVAL)
        if not data or QUIT in data:
            break
        if halted := halted or HALT in data:
            commands.stop()
        stops = 0
        patience = STOP_INTERVAL if halted else timeout if data.endswith(HEARTBEAT) else None
    transport.close()
