from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator

import pytest

from rover_rl.sims.ros2 import Ros2Settings
from rover_rl.sims.ros2.dds import DdsTransport
from rover_rl.sims.ros2.messages import Twist, TwistStamped
from rover_rl.sims.ros2.watchdog import Watchdog
from tests.sims.ros2.processes import until

pytestmark = [pytest.mark.ros2, pytest.mark.slow]


LIVE = Ros2Settings(frame_id="base")


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


def test_the_watchdog_exits_with_the_drive_and_sends_nothing_before(commands):
    with Watchdog("/cmd_vel", LIVE, timeout=100.0) as watchdog:
        send_heartbeats(watchdog, 5)
    assert watchdog._process.poll() == 0
    assert not commands


def test_missing_heartbeats_stop_the_rover(commands):
    with Watchdog("/cmd_vel", LIVE, timeout=0.2) as watchdog:
        time.sleep(0.5)
        assert not commands  # before the first heartbeat
        watchdog.alive()
        until(lambda: len(commands) > 10)
    assert all(twist == Twist() for twist in commands)


def test_stamped_stop_commands(in_domain):
    received: list[TwistStamped] = []
    transport = DdsTransport("rover")
    transport.subscribe("/cmd_vel", TwistStamped, received.append)
    with Watchdog("/cmd_vel", Ros2Settings(command="twist_stamped", frame_id="base"), timeout=0.1) as watchdog:
        watchdog.alive()
        until(lambda: received)
    transport.close()
    assert received[0].header.frame_id == "base"
    assert received[0].header.stamp.sec == pytest.approx(time.time(), abs=600)


def test_a_watchdog_that_is_gone_or_hangs_raises_an_error(commands):
    with Watchdog("/cmd_vel", LIVE, timeout=100.0) as watchdog:
        watchdog._process.send_signal(signal.SIGSTOP)
        with pytest.raises(ChildProcessError, match="the watchdog is gone"):
            send_heartbeats(watchdog, 1 << 20)  # more than a pipe holds
        watchdog._process.kill()
        watchdog._process.wait()
        with pytest.raises(ChildProcessError, match="the watchdog is gone"):
            watchdog.alive()


def test_a_killed_driving_process_stops_the_rover(commands):
    program = (
        "import time\n"
        "from rover_rl.sims.ros2 import Ros2Settings\n"
        "from rover_rl.sims.ros2.watchdog import Watchdog\n"
        "with Watchdog('/cmd_vel', Ros2Settings(), 100.0) as watchdog:\n"
        "    watchdog.alive()\n"
        "    print('driving', flush=True)\n"
        "    time.sleep(60)\n"
    )
    driver = subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True, env=os.environ)
    try:
        assert driver.stdout is not None
        assert driver.stdout.readline() == "driving\n"
        assert not commands
    finally:
        driver.kill()
        driver.communicate()
    until(lambda: len(commands) > 10)


def test_a_halt_stops_the_rover_for_good_whatever_the_driving_process_does(commands):
    with Watchdog("/cmd_vel", LIVE, timeout=100.0) as watchdog:
        watchdog.alive()
        watchdog.halt()
        until(lambda: len(commands) > 3)
        watchdog.alive()
        count = len(commands)
        until(lambda: len(commands) > count + 10)
    assert all(twist == Twist() for twist in commands)
