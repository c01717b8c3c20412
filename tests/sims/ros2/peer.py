"""Processes with ROS 2's own rclpy, which has a virtual environment of its own (``peers/requirements.txt``)."""

from __future__ import annotations

import json
import os
import platform
import subprocess
import sys
import sysconfig
import threading
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest

from tests.pages import ROOT

PROGRAMS = Path(__file__).with_name("peers")


def find_peer() -> str:
    """Returns the path of the Python with rclpy. Skips the test if there is none; in CI, it fails.

    ``make test`` installs it into a folder of this virtual environment. ``ROVER_RL_PEER`` names another Python, which
    must be of the version of this one.
    """
    python = os.environ.get("ROVER_RL_PEER") or str(Path(sys.prefix, "peer", "bin", "python"))
    version = "import rclpy, sys; print(sys.version_info[:2])"
    found = ""
    with suppress(OSError):
        found = subprocess.run([python, "-c", version], capture_output=True, text=True).stdout.strip()
    if found != str(sys.version_info[:2]):
        has_wheels = (platform.system(), platform.machine()) == ("Linux", "x86_64")
        reason = f"{python} is no Python {sys.version_info[:2]} with rclpy: make test installs one, where it can"
        (pytest.fail if os.environ.get("CI") and has_wheels else pytest.skip)(reason)
    return python


class Peer:
    """A program in ``peers/`` with rclpy and this package, in a process of its own. It talks in lines of JSON.

    Args:
        python: Python with rclpy.
        environment: environment variables, among them those of the DDS domain.
        program: name of the program.
        arguments: arguments of the command line.
    """

    def __init__(self, python: str, environment: dict[str, str], program: str, *arguments: str) -> None:
        variables = {
            # Without shared memory, a killed process leaves nothing behind.
            "FASTDDS_BUILTIN_TRANSPORTS": "UDPv4",
            "ROS_LOG_DIR": str(Path(os.environ["XDG_CACHE_HOME"], "ros")),
            "PYTHONPATH": os.pathsep.join((str(ROOT), sysconfig.get_path("purelib"))),
        }
        command = [python, str(PROGRAMS / f"{program}.py"), *arguments]
        self.process = subprocess.Popen(
            command, env={**environment, **variables}, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )

    def read(self) -> Any:
        """Returns the next line of the output, which must come within two minutes."""
        assert self.process.stdout is not None
        timer = threading.Timer(120.0, self.process.kill)
        timer.start()
        line = self.process.stdout.readline()
        timer.cancel()
        assert line, "the program has ended"
        return json.loads(line)

    def write(self, line: Any) -> None:
        """Writes a line of the input."""
        assert self.process.stdin is not None
        self.process.stdin.write(json.dumps(line) + "\n")
        self.process.stdin.flush()

    def kill(self) -> None:
        """Kills the process and waits for its end."""
        self.process.kill()
        self.process.communicate()


class RosNode(Peer):
    """A node of rclpy. Moments are those of ``time.monotonic()``; messages are dictionaries.

    Args:
        python: Python with rclpy.
        environment: environment variables, among them those of the DDS domain.
        name: name of the node.
    """

    def __init__(self, python: str, environment: dict[str, str], name: str = "peer") -> None:
        super().__init__(python, environment, "node", name)
        assert self.read() == "up"

    def subscribe(self, topic: str, kind: str, reliable: bool = True, depth: int = 10) -> None:
        """Subscribes to a topic, volatile."""
        self._call("subscribe", topic, kind, reliable, depth)

    def received(self, topic: str) -> list[tuple[float, Any]]:
        """Returns the messages on a topic since the last call, each with the moment of its arrival."""
        return self._call("received", topic)

    def count(self, topic: str) -> int:
        """Returns the number of those messages, and leaves them."""
        return self._call("count", topic)

    def publish(self, topic: str, kind: str, fields: dict[str, Any], rate: float = 0.0) -> int:
        """Publishes a message once, or from now on at a rate, Hz. Returns the number of matched subscriptions."""
        return self._call("publish", topic, kind, fields, rate)

    def publishers(self, topic: str) -> list[dict[str, Any]]:
        """Returns node, type, reliability and durability of each publisher on a topic."""
        return self._call("publishers", topic)

    def subscriptions(self, topic: str) -> list[dict[str, Any]]:
        """Returns those of each subscription."""
        return self._call("subscriptions", topic)

    def nodes(self) -> list[str]:
        """Returns the names of all nodes."""
        return self._call("nodes")

    def _call(self, *call: Any) -> Any:
        self.write(call)
        return self.read()
