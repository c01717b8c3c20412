"""Stops the rover when the process that drives it dies or hangs: a process of its own that waits for signs of life.

:class:`Watchdog` is the driver's end. The other end is this module run as a program: it reads signs of life from its
standard input, and once they stay away sends stops until they come again, or for a while if the driver is gone.
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
from typing import Annotated

import tyro

from rover_rl.sims.ros2.commands import Commands
from rover_rl.sims.ros2.settings import Command, Ros2Settings, TransportName
from rover_rl.sims.ros2.transport import make_transport

READY = b"ready\n"
ALIVE = b"."
DONE = b"q"
INTERVAL = 0.05
"""Seconds from one stop to the next."""
PERSISTENCE = 2.0
"""Seconds that stops are sent for when the driver is gone."""
MEET_TIMEOUT = 3.0
"""Seconds to wait for a rover that listens, before all is said to be ready."""
START_TIMEOUT = 60.0
"""Seconds that the process may take to come up."""
END_TIMEOUT = 5.0
"""Seconds that it may take to end."""


class Watchdog:
    """Starts the process; a context manager. The rover should not move before it is entered.

    Args:
        topic: of the rover's command.
        settings: how the rover is reached.
        patience: seconds without a sign of life after which the rover is stopped.

    Raises:
        ChildProcessError: if the process does not come up.
    """

    def __init__(self, topic: str, settings: Ros2Settings, patience: float = 0.5) -> None:
        options = {
            "topic": topic,
            "command": settings.command,
            "transport": settings.transport,
            "frame-id": settings.frame_id,
            "patience": str(patience),
        }
        arguments = [word for name, value in options.items() for word in (f"--{name}", value)]
        # A session of its own: Ctrl-C is for the driver, and this must outlive it.
        self._process = subprocess.Popen(
            [sys.executable, "-m", "rover_rl.sims.ros2.watchdog", *arguments],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            start_new_session=True,
        )
        assert self._process.stdin is not None
        # One that hangs until the pipe is full is as good as gone, and must not hold up the driver.
        os.set_blocking(self._process.stdin.fileno(), False)

    def __enter__(self) -> Watchdog:
        assert self._process.stdout is not None
        ready, _, _ = select.select([self._process.stdout], [], [], START_TIMEOUT)
        if not ready or self._process.stdout.readline() != READY:
            self.close()
            raise ChildProcessError("the watchdog did not come up, so the rover is not driven")
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def alive(self) -> None:
        """Tells that the driver is at work; to be called at every step.

        Raises:
            ChildProcessError: if the watchdog itself is gone.
        """
        self._tell(ALIVE)

    def close(self) -> None:
        """Ends the process; may be called again."""
        if self._process.poll() is None:
            with contextlib.suppress(ChildProcessError):
                self._tell(DONE)
            try:
                self._process.wait(END_TIMEOUT)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()
        for pipe in (self._process.stdin, self._process.stdout):
            if pipe is not None:
                pipe.close()

    def _tell(self, sign: bytes) -> None:
        assert self._process.stdin is not None
        try:
            os.write(self._process.stdin.fileno(), sign)
        except (OSError, ValueError) as error:
            raise ChildProcessError("the watchdog is gone, so the rover is not driven on") from error


@dataclass(frozen=True)
class Watch:
    """The process: reads signs of life from standard input, and stops the rover without them."""

    topic: str
    command: Command
    transport: TransportName
    frame_id: str
    patience: Annotated[float, tyro.conf.arg(help="Seconds without a sign of life.")]

    def __call__(self) -> None:
        """Watches until the driver is done, or gone and the rover stopped."""
        transport = make_transport(self.transport, "rover_rl_watchdog")
        commands = Commands(transport, self.topic, self.command, self.frame_id)
        deadline = time.monotonic() + MEET_TIMEOUT
        while not transport.subscribers(self.topic) and time.monotonic() < deadline:
            time.sleep(INTERVAL)
        sys.stdout.buffer.write(READY)
        sys.stdout.buffer.flush()
        wait: float | None = None  # nothing is stopped before the first sign of life
        while True:
            signs = self._signs(wait)
            if signs is None:
                commands.stop()
                wait = INTERVAL
            elif DONE in signs:
                break
            elif signs:
                wait = self.patience
            else:
                for _ in range(round(PERSISTENCE / INTERVAL)):
                    commands.stop()
                    time.sleep(INTERVAL)
                break
        transport.close()

    @staticmethod
    def _signs(timeout: float | None) -> bytes | None:
        """What has come in: no bytes if the driver is gone, ``None`` if nothing came in time (s)."""
        ready, _, _ = select.select([sys.stdin], [], [], timeout)
        return os.read(sys.stdin.fileno(), 4096) if ready else None


if __name__ == "__main__":
    tyro.cli(Watch)()
