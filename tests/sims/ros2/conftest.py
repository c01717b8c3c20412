from __future__ import annotations

import os
import random

import pytest

from tests.sims.ros2.wire import Wire


@pytest.fixture(scope="session")
def domain() -> dict[str, str]:
    """Variables of a domain that nobody else should be in, on this machine alone."""
    # Of its own randomness, for other runs of the tests; workers of one run have odd and even blocks of five, of which
    # tests use the numbers that follow. Above 101 ports would be those that Linux gives to anybody.
    worker = int(os.environ.get("PYTEST_XDIST_WORKER", "gw0").removeprefix("gw"))
    block = 2 * random.SystemRandom().randrange(10) + worker % 2
    return {"ROS_DOMAIN_ID": str(5 * block), "ROS_LOCALHOST_ONLY": "1"}


@pytest.fixture
def in_domain(domain: dict[str, str], monkeypatch: pytest.MonkeyPatch) -> dict[str, str]:
    """This process's environment, in that domain; for processes that it starts."""
    for key, value in domain.items():
        monkeypatch.setenv(key, value)
    monkeypatch.delenv("CYCLONEDDS_URI", raising=False)
    return dict(os.environ)


@pytest.fixture
def wire(monkeypatch: pytest.MonkeyPatch) -> Wire:
    """What all simulators of the test talk over."""
    wire = Wire()
    monkeypatch.setattr("rover_rl.sims.ros2.simulator.make_transport", lambda name, node: wire)
    return wire
