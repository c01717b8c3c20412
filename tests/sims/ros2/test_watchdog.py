from __future__ import annotations

import signal
import time
from collections.abc import Iterator

import pytest

from rover_rl.sims.ros2 import Ros2Settings
from rover_rl.sims.ros2.commands import Watchdog
from rover_rl.sims.ros2.dds import DdsTransport
from rover_rl.sims.ros2.messages import Twist
from tests.sims.ros2.processes import until

pytestmark = [pytest.mark.ros2, pytest.mark.slow]

LIVE = Ros2Settings()


@pytest.fixture
def commands(in_domain) -> Iterator[list[Twist]]:
    """Commands that arrive at the rover."""
    received: list[Twist] = []
    transport = DdsTransport("rover")
    transport.subscribe("/cmd_vel", Twist, received.append)
    yield received
    transport.close()


def send_heartbeats(watchdog: Watchdog, count: int) -> None:
    for _ in range(count):
        watchdog.alive()


def test_missing_heartbeats_stop_the_rover(commands):
    with Watchdog("/cmd_vel", LIVE, timeout=0.2) as watchdog:
        time.sleep(0.5)
        assert not commands  # before the first heartbeat
        watchdog.alive()
        until(lambda: len(commands) > 10)
    assert all(twist == Twist() for twist in commands)


def test_a_watchdog_that_is_gone_or_hangs_raises_an_error(commands):
    with Watchdog("/cmd_vel", LIVE, timeout=100.0) as watchdog:
        watchdog._process.send_signal(signal.SIGSTOP)
        with pytest.raises(ChildProcessError, match="the watchdog is gone"):
            send_heartbeats(watchdog, 1 << 20)  # more than a pipe holds
        watchdog._process.kill()
        watchdog._process.wait()
        with pytest.raises(ChildProcessError, match="the watchdog is gone"):
            watchdog.alive()


def test_a_halt_stops_the_rover_for_good_whatever_the_driving_process_does(commands):
    with Watchdog("/cmd_vel", LIVE, timeout=100.0) as watchdog:
        watchdog.alive()
        watchdog.halt()
        until(lambda: len(commands) > 3)
        watchdog.alive()
        count = len(commands)
        until(lambda: len(commands) > count + 10)
    assert all(twist == Twist() for twist in commands)
