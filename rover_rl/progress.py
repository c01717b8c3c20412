"""Progress of long operations: a bar on a terminal, and lines elsewhere, such as in a log file."""

from __future__ import annotations

import errno
import math
import os
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from datetime import timedelta
from typing import TypeVar

from rich.console import Console
from rich.progress import BarColumn, Progress, ProgressColumn, Task, TaskProgressColumn, TextColumn, TimeElapsedColumn
from rich.text import Text

from rover_rl.files import STANDARD_OUTPUT, errors_name

Item = TypeVar("Item")

_SPEED_PERIOD = 600.0
"""Recent time from which the remaining time is estimated, s. Some operations advance only every minute."""

_redirected: ContextVar[Callable[[float], None] | None] = ContextVar("redirected", default=None)
"""Function that receives the progress of all displays instead of the console."""


class _RemainingColumn(ProgressColumn):
    def __init__(self, remaining: Callable[[], float]) -> None:
        super().__init__()
        self._remaining = remaining

    def render(self, task: Task) -> Text:
        # Empty while there is no estimate.
        seconds = math.ceil(self._remaining())
        return Text(f"left {timedelta(seconds=seconds)}" if seconds > 0 else "", style="progress.remaining")


class ProgressDisplay:
    """Shows the progress of an operation: a bar on a terminal; elsewhere a line at least every 4 seconds.

    The lines come from a thread, so that they also appear during a single long call, such as compiling.

    Args:
        description: name of the operation, such as ``"training"``.
        keep: whether the bar stays on the terminal when the operation has ended.
        tenths: whether lines are also printed after each tenth of the operation.
        console: console to print to; ``None``: standard output.
        interval: longest time between two lines, s.
        estimate: whether the remaining time is estimated; not if some parts take a thousand times as long as others.
    """

    def __init__(
        self,
        description: str,
        *,
        keep: bool = False,
        tenths: bool = False,
        console: Console | None = None,
        interval: float = 4.0,
        estimate: bool = True,
    ) -> None:
        self._description, self._tenths, self._interval = description, tenths, interval
        self._estimate = estimate
        self._redirect = _redirected.get()
        self._lines = self._redirect is None and not (console or Console()).is_terminal
        self._bar = Progress(
            TextColumn("{task.description}", markup=False),
            BarColumn(20),
            TaskProgressColumn(),
            TimeElapsedColumn(),
            _RemainingColumn(self._remaining),
            TextColumn("{task.fields[status]}", markup=False),
            console=console,
            transient=not keep,
            disable=self._lines or self._redirect is not None,
            speed_estimate_period=_SPEED_PERIOD,
        )
        # Without a total, the bar pulses.
        self._task = self._bar.add_task(description, total=None, status="")
        self._fraction: float | None = None
        self._status = ""
        self._started = self._printed = self._updated = time.monotonic()
        # A signal handler may print while the same thread prints.
        self._lock, self._ended = threading.RLock(), threading.Event()
        self._error: OSError | None = None
        self._thread = threading.Thread(target=self._print_regularly, name="progress", daemon=True)

    def __enter__(self) -> ProgressDisplay:
        self._started = self._printed = time.monotonic()
        self._bar.start()
        if self._lines:
            self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        if self._thread.is_alive():
            # A line must not appear below the results of the operation.
            self._thread.join()
        self._bar.stop()

    def update(self, fraction: float, status: str = "") -> None:
        """Shows the fraction of the operation that is done, and figures or the current activity.

        Like :meth:`say`, it raises ``OSError`` if the output cannot be written, for example after ``| head``.
        """
        if self._redirect is not None:
            self._redirect(fraction)
            return
        if self._error is not None:
            raise self._error
        another_tenth = int(fraction * 10) > int((self._fraction or 0.0) * 10)
        self._fraction, self._status, self._updated = fraction, status, time.monotonic()
        self._bar.update(self._task, total=1.0, completed=fraction, status=status)
        if self._lines and self._tenths and another_tenth:
            self._print_line()

    def say(self, text: str) -> None:
        """Prints a line, on a terminal above the bar."""
        with self._lock, errors_name(STANDARD_OUTPUT):
            self._printed = time.monotonic()
            try:
                self._bar.console.print(text, soft_wrap=True, highlight=False, markup=False)
            except SystemExit as error:
                # Rich exits when a pipe is closed, which would only end the thread that prints regularly.
                raise BrokenPipeError(errno.EPIPE, os.strerror(errno.EPIPE)) from error

    def track(self, items: Iterable[Item], count: int) -> Iterator[Item]:
        """Yields ``count`` items and shows which fraction of them is done."""
        for done, item in enumerate(items, 1):
            yield item
            self.update(done / count)

    def _remaining(self) -> float:
        # Not positive if there is no estimate, or it has turned out wrong.
        seconds = self._bar.tasks[0].time_remaining if self._estimate else None
        return (seconds or 0.0) - (time.monotonic() - self._updated)

    def _print_line(self) -> None:
        share = "" if self._fraction is None else f" {self._fraction:4.0%}"
        left, seconds = "", self._remaining()
        if seconds > 0:
            left = f", about {seconds:.0f} s left" if seconds < 120 else f", about {seconds / 60:.0f} min left"
        status = f": {self._status}" if self._status else ""
        self.say(f"{self._description}{share} after {time.monotonic() - self._started:.0f} s{left}{status}")

    def _print_regularly(self) -> None:
        while not self._ended.wait(max(0.0, self._printed + self._interval - time.monotonic())):
            if time.monotonic() >= self._printed + self._interval:
                try:
                    self._print_line()
                except OSError as error:
                    self._error = error
                    return


@contextmanager
def redirected_progress(report: Callable[[float], None]) -> Iterator[None]:
    """Sends the fractions of all displays that are created in the block to ``report``; they show nothing themselves."""
    token = _redirected.set(report)
    try:
        yield
    finally:
        _redirected.reset(token)
