"""Progress of long operations on a terminal, elsewhere, and in workers."""

from __future__ import annotations

import io
import re
import threading
import time

import pytest
from rich.console import Console

from rover_rl.progress import ProgressDisplay, redirected_progress

QUICK = 0.01
"""Interval of lines, s."""


class Watched(io.StringIO):
    """Text in memory that a test can wait for."""

    def wait_for(self, text: str, times: int = 1) -> None:
        latest = time.monotonic() + 60
        while self.getvalue().count(text) < times:
            assert time.monotonic() < latest, self.getvalue()
            time.sleep(QUICK)


def display_on(output: io.StringIO, terminal: bool = False, **settings: object) -> ProgressDisplay:
    console = Console(file=output, force_terminal=terminal, width=120, _environ={})
    return ProgressDisplay("working", console=console, **settings)  # type: ignore[arg-type]


def test_lines_appear_during_a_single_long_call_and_none_after_the_end() -> None:
    output = Watched()
    with display_on(output, interval=QUICK) as display:
        # Blocks this thread, as a compiler does. The amount of work is unknown.
        output.wait_for("working after 0 s\n", times=2)
        assert "%" not in output.getvalue()
        display.update(0.25, "third wheel")
        output.wait_for("working  25% after 0 s: third wheel\n")
    assert not [thread for thread in threading.enumerate() if thread.name == "progress"]


def test_tenths_are_lines_of_their_own_with_the_remaining_time_at_the_latest_speed() -> None:
    output = Watched()
    with display_on(output, tenths=True) as display:
        # The first half is from an earlier run.
        for fraction in (0.5, 0.502, 0.61, 0.69, 1.0):
            display.update(fraction, f"at {fraction}")
            time.sleep(0.02)
    lines = output.getvalue().splitlines()
    assert [line.split()[1] for line in lines] == ["50%", "61%", "100%"]
    assert re.fullmatch(r"working  61% after 0 s, about \d+ s left: at 0.61", lines[1])
    assert lines[2] == "working 100% after 0 s: at 1.0"


@pytest.mark.parametrize("terminal", [False, True])
def test_an_estimate_that_has_turned_out_wrong_is_not_shown(terminal: bool) -> None:
    output = Watched()
    with display_on(output, terminal, interval=QUICK) as display:
        # A hundred quick parts, and one that takes much longer.
        for part in range(100):
            display.update(part / 101, "quick")
            time.sleep(QUICK / 10)
        display.update(100 / 101, "slow")
        # The estimate is a second.
        time.sleep(1.2)
        start = len(output.getvalue())
        time.sleep(0.3)
    assert "slow" in output.getvalue()[start:]
    assert "left" not in output.getvalue()[start:]


def test_a_terminal_shows_a_bar() -> None:
    output = Watched()
    with display_on(output, terminal=True, keep=True) as display:
        for _ in display.track(range(4), 4):
            pass
        display.update(1.0, "all of it")
        display.say("a line above")
    told = output.getvalue()
    assert [part for part in ("━", "working", "100%", "all of it", "a line above") if part not in told] == []
    assert "after 0 s" not in told


def test_redirected_progress_reaches_the_function_alone() -> None:
    output, fractions = Watched(), []
    with redirected_progress(fractions.append), display_on(output, tenths=True, interval=QUICK) as display:
        display.update(0.25)
        display.update(0.5, "half")
    assert (fractions, output.getvalue()) == ([0.25, 0.5], "")
    with display_on(output, tenths=True) as display:
        display.update(1.0)
    assert fractions == [0.25, 0.5]
    assert "100%" in output.getvalue()


class Closed(io.StringIO):
    def write(self, text: str) -> int:
        raise OSError(28, "No space left on device")


def test_output_that_cannot_be_written_raises_at_the_next_update() -> None:
    def updates(display: ProgressDisplay) -> None:
        latest = time.monotonic() + 60
        while time.monotonic() < latest:
            display.update(0.5)
            time.sleep(QUICK)

    with (
        display_on(Closed(), interval=QUICK) as display,
        pytest.raises(OSError, match=r"No space left.*standard output"),
    ):
        updates(display)
