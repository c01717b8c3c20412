"""Robots, programs that drive them, and nodes of ROS 2's own rclpy, over the network."""

from __future__ import annotations

import json
import os
import platform
import subprocess
import sys
import sysconfig
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest

from tests.fork_server import fork_server
from tests.pages import ROOT


def until(condition: Callable[[], object], seconds: float = 120.0) -> None:
    """Waits until a condition holds, at most for the given time (s)."""
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "the condition does not hold in time"
        time.sleep(0.01)


class NetworkRobot:
    """What ``rover-rl robot`` serves, in a thread of this process. ``twists`` has the commands that arrive."""

    def __init__(self, environment: dict[str, str]) -> None:
        from rover_rl import EnvConfig, LidarConfig
        from rover_rl.envs.served_rover import ServedRover
        from rover_rl.sims.ros2.dds import DdsTransport
        from rover_rl.sims.ros2.messages import Twist
        from rover_rl.sims.ros2.robot import RobotNode

        self.rover = ServedRover(EnvConfig(world="maze", lidar=LidarConfig(beams=128), seed=0))
        self.twists: list[tuple[float, float]] = []
        self._transport, self._stop = DdsTransport("rover_zero", environment), threading.Event()
        node = RobotNode(self.rover, self._transport)
        self._transport.subscribe("/cmd_vel", Twist, lambda sent: self.twists.append((sent.linear.x, sent.angular.z)))
        self._thread = threading.Thread(target=node.run, args=(1.0, self._stop))
        self._thread.start()

    def is_told(self, speed: float) -> bool:
        """Whether the last ten commands have a forward speed, m/s: those of one driver, when there are two."""
        return [each for each, _ in self.twists[-10:]] == [pytest.approx(speed)] * 10

    def close(self) -> None:
        self._stop.set()
        self._thread.join()
        self._transport.close()
        self.rover.close()


def drive(environment: dict[str, str]) -> Any:
    """Starts a program that drives a curve, in a process that has imported the package. Returns the process."""
    process = fork_server().Process(target=_drive_in, args=(environment,), daemon=True)  # type: ignore[attr-defined]
    process.start()
    return process


def _drive_in(environment: dict[str, str]) -> None:
    os.environ.update(environment)
    drive_a_curve("dds")


def drive_a_curve(transport: str, reset: str = "none") -> str:
    """Drives a curve until an error, which is returned."""
    import torch

    from rover_rl.robots import get_robot
    from rover_rl.sims.ros2 import Ros2Settings
    from rover_rl.sims.ros2.simulator import Ros2Simulator
    from rover_rl.sims.settings import Connection
    from rover_rl.worlds import get_world

    settings = Ros2Settings(transport=transport, reset=reset, reset_timeout=60.0, step_timeout=20.0)
    simulator = Ros2Simulator([get_world("maze")], get_robot("rover_zero"), settings, Connection(timeout=60.0))
    try:
        simulator.reset(torch.ones(1, dtype=torch.bool), torch.zeros(1, 3))
        while True:
            simulator.step(torch.tensor([[0.3, 0.5]]))
    except OSError as error:
        return str(error)
    finally:
        simulator.close()


def find_peer() -> str:
    """Returns the path of the Python with rclpy. Skips the test if there is none; in CI, it fails.

    ``make test`` installs it into a folder of this virtual environment (``peers/requirements.txt``). ``ROVER_RL_PEER``
    names another Python, which must be of the version of this one.
    """
    python = os.environ.get("ROVER_RL_PEER") or str(Path(sys.prefix, "peer", "bin", "python"))
    version, found = "import rclpy, sys; print(sys.version_info[:2])", ""
    with suppress(OSError):
        found = subprocess.run([python, "-c", version], capture_output=True, text=True).stdout.strip()
    if found != str(sys.version_info[:2]):
        has_wheels = (platform.system(), platform.machine()) == ("Linux", "x86_64")
        reason = f"{python} is no Python {sys.version_info[:2]} with rclpy: make test installs one, where it can"
        (pytest.fail if os.environ.get("CI") and has_wheels else pytest.skip)(reason)
    return python


class Peer:
    """A program in ``peers/`` with rclpy and this package, in a process of its own. It talks in lines of JSON."""

    def __init__(self, python: str, environment: dict[str, str], program: str) -> None:
        variables = {
            # Without shared memory, a killed process leaves nothing behind.
            "FASTDDS_BUILTIN_TRANSPORTS": "UDPv4",
            "ROS_LOG_DIR": str(Path(os.environ["XDG_CACHE_HOME"], "ros")),
            "PYTHONPATH": os.pathsep.join((str(ROOT), sysconfig.get_path("purelib"))),
        }
        started = [python, str(Path(__file__).with_name("peers") / f"{program}.py")]
        pipes: Any = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
        self._process = subprocess.Popen(started, env={**environment, **variables}, **pipes)
        assert self.read() == "up"

    def read(self) -> Any:
        """Returns the next line of the output, which must come within two minutes."""
        assert self._process.stdout is not None
        timer = threading.Timer(120.0, self._process.kill)
        timer.start()
        line = self._process.stdout.readline()
        timer.cancel()
        assert line, "the program has ended"
        return json.loads(line)

    def __getattr__(self, method: str) -> Callable[..., Any]:
        """A method of the program ``node``."""

        def call(*arguments: Any) -> Any:
            assert self._process.stdin is not None
            self._process.stdin.write(json.dumps([method, *arguments]) + "\n")
            self._process.stdin.flush()
            return self.read()

        return call

    def close(self) -> None:
        """Kills the process and waits for its end."""
        self._process.kill()
        self._process.communicate()
