from __future__ import annotations

import math
import os
import random
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import replace
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from rover_rl import EnvConfig, RoverEnv, World
    from tests.sims.ros2.wire import Rover, SimulatedRobot, Wire

# The tests need rover_rl[ros2].
collect_ignore_glob = [] if find_spec("rosbags") and find_spec("cyclonedds") else ["test_*.py"]


@pytest.fixture(scope="session")
def domain() -> dict[str, str]:
    """Environment variables of a DDS domain for this test run, on this machine only."""
    # Not seeded, so that concurrent test runs differ. The workers of one run use odd and even blocks of five domains;
    # tests also use the domains that follow the first one. Domains above 101 use Linux's ephemeral ports.
    worker = int(os.environ.get("PYTEST_XDIST_WORKER", "gw0").removeprefix("gw"))
    block = 2 * random.SystemRandom().randrange(10) + worker % 2
    return {"ROS_DOMAIN_ID": str(5 * block), "ROS_LOCALHOST_ONLY": "1"}


@pytest.fixture
def in_domain(domain: dict[str, str], monkeypatch: pytest.MonkeyPatch) -> None:
    """Puts this process in that domain."""
    for key, value in domain.items():
        monkeypatch.setenv(key, value)
    monkeypatch.delenv("CYCLONEDDS_URI", raising=False)


@pytest.fixture
def wire(monkeypatch: pytest.MonkeyPatch) -> Wire:
    """Transport of all simulators in the test, whose waiting steps the rovers on it, and whose time is theirs."""
    from tests.sims.ros2.wire import QuietWatchdog, Wire

    wire = Wire()
    for module in ("commands", "ground", "poses", "robot", "sensors", "simulator", "transport"):
        monkeypatch.setattr(f"rover_rl.sims.ros2.{module}.time", wire)
    monkeypatch.setattr("rover_rl.sims.ros2.simulator.make_transport", lambda *_: wire)
    monkeypatch.setattr("rover_rl.sims.ros2.commands.Watchdog", QuietWatchdog)
    monkeypatch.setattr(
        "rover_rl.sims.ros2.sensors.LatestMessages.wait", lambda *args, **kwargs: wire.wait(*args, **kwargs)
    )
    return wire


@pytest.fixture
def rover(wire: Wire) -> Rover:
    from tests.sims.ros2.wire import Rover

    return Rover(wire)


@pytest.fixture
def start_env(wire: Wire) -> Iterator[Callable[..., tuple[SimulatedRobot, RoverEnv]]]:
    """Starts a simulated robot on the wire, in a world at a pose, and the environment that drives it."""
    from rover_rl import EnvConfig, RoverEnv
    from rover_rl.sims.ros2 import Ros2Settings
    from tests.sims.ros2.wire import SimulatedRobot

    with ExitStack() as stack:

        def start(
            world: World, pose: Any, view: float = 2 * math.pi, made_for: EnvConfig | None = None, **settings: Any
        ) -> tuple[SimulatedRobot, RoverEnv]:
            robot = SimulatedRobot(wire, world, pose, view)
            stack.callback(robot.rover.close)
            backend = Ros2Settings(**{"reset": "none", "settle": 0.05, **settings})
            config = made_for or EnvConfig()
            env = RoverEnv(replace(config, world=world, length=10**9, backend=backend, end_on_goal=True, seed=0))
            stack.callback(env.close)
            return robot, env

        yield start
