"""Programs of one's own that drive ``rover-rl robot``, before ROS 2's own rclpy: hangs, deaths, and other drivers."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from tests.sims.ros2 import programs
from tests.sims.ros2.peer import Peer, RosNode
from tests.sims.ros2.processes import Command, start_robot, until

pytestmark = [pytest.mark.ros2, pytest.mark.slow]

TWIST = "geometry_msgs/msg/Twist"


@pytest.fixture(scope="module")
def environment(domain) -> dict[str, str]:
    """Environment variables of processes in a domain of these tests."""
    return {**os.environ, **domain, "ROS_DOMAIN_ID": str(int(domain["ROS_DOMAIN_ID"]) + 2)}


@pytest.fixture(scope="module")
def robot(environment) -> Iterator[Command]:
    robot = start_robot(environment, "--world", "maze")
    yield robot
    robot.kill()


@pytest.fixture(scope="module")
def listener(peer, environment, robot) -> Iterator[RosNode]:
    """Hears the commands."""
    node = RosNode(peer, environment, "listener")
    node.subscribe("/cmd_vel", TWIST)
    yield node
    node.kill()


@pytest.fixture
def teleop(peer, environment) -> Iterator[RosNode]:
    """Another driver, which has sent once."""
    node = RosNode(peer, environment, "teleop")
    node.publish("/cmd_vel", TWIST, {})
    yield node
    node.kill()


@pytest.fixture
def report(tmp_path) -> Path:
    return tmp_path / "report"


@pytest.fixture
def start(peer, environment, listener, report) -> Iterator[Callable[..., Any]]:
    """Starts a program, over either transport; kills all started ones at the end, and waits for their watchdogs."""
    with ExitStack() as stack:

        def run(transport: str = "dds", **options: Any) -> Any:
            if transport == "dds":
                program = programs.start(environment, report, **options)
            else:
                started = Peer(peer, environment, "../programs", str(report))
                stack.callback(started.kill)
                assert started.read() == "up"
                program = started.process
            stack.callback(program.kill)
            listener.received("/cmd_vel")
            return program

        yield run
    until(partial(is_silent, listener))


def twists(listener: RosNode) -> list[tuple[float, float, float]]:
    """Returns the moment, speed and yaw rate of each command since the last call."""
    return [(moment, twist["linear"]["x"], twist["angular"]["z"]) for moment, twist in listener.received("/cmd_vel")]


def drives(listener: RosNode) -> bool:
    return any(speed > 0.2 for _, speed, _ in twists(listener))


def only_drives(listener: RosNode) -> bool:
    """Whether no stop has come within half a second; late scans on a busy machine bring some."""
    twists(listener)
    time.sleep(0.5)
    return min((speed for _, speed, _ in twists(listener)), default=0.0) > 0.2


def is_stopped(listener: RosNode) -> bool:
    """Whether the next commands are stops."""
    twists(listener)
    time.sleep(0.1)
    return {twist[1:] for twist in twists(listener)} == {(0.0, 0.0)}


def is_silent(listener: RosNode) -> bool:
    twists(listener)
    time.sleep(0.5)
    return not twists(listener)


@pytest.mark.parametrize(("transport", "number"), [("dds", signal.SIGKILL), ("dds", signal.SIGSTOP)])
def test_a_program_that_dies_or_hangs_leaves_a_rover_that_stands(start, listener, transport, number):
    program = start(transport)
    until(lambda: drives(listener))
    os.kill(program.pid, number)
    until(lambda: is_stopped(listener))


def test_a_program_that_pauses_goes_on_with_a_rover_that_was_stopped_meanwhile(start, listener, report):
    start(steps=20, pause=1.5)
    until(lambda: drives(listener))
    until(lambda: is_stopped(listener))
    until(lambda: drives(listener))
    assert not report.exists()


@pytest.mark.parametrize("transport", ["rclpy"])
def test_another_driver_stops_a_program_and_is_named(start, listener, teleop, report, transport):
    start(transport)
    until(lambda: drives(listener))  # although the other driver has a publisher
    teleop.publish("/cmd_vel", TWIST, {"linear": {"x": -0.1}}, rate=10.0)
    until(report.exists)
    until(report.read_text)
    assert report.read_text().startswith(
        "/teleop also sends commands on /cmd_vel, so that the rover is stopped: end it"
    )
    until(lambda: is_only_from(listener, -0.1))


def is_only_from(listener: RosNode, speed: float) -> bool:
    """Whether only commands of this speed have come within half a second."""
    twists(listener)
    time.sleep(0.5)
    return {twist[1] for twist in twists(listener)} == {speed}


def test_a_second_program_is_refused_and_the_first_drives_on(start, listener, report):
    start(node="first")
    until(lambda: drives(listener))
    start(node="second")
    until(report.exists)
    until(report.read_text)
    assert report.read_text().startswith("/first also sends commands on /cmd_vel")
    until(lambda: only_drives(listener))
    assert report.read_text().startswith("/first")  # the first has not ended meanwhile


def test_with_give_way_another_driver_wins_until_it_ceases(start, listener, teleop, report):
    start(give_way=True)
    until(lambda: drives(listener))
    teleop.publish("/cmd_vel", TWIST, {"linear": {"x": -0.1}}, rate=20.0)
    until(lambda: is_only_from(listener, -0.1))
    teleop.publish("/cmd_vel", TWIST, {})
    until(lambda: drives(listener))
    assert not report.exists()
