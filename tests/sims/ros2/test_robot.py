from __future__ import annotations

import itertools
import math
import os
import signal
import subprocess
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
import torch
from torchrl.envs.utils import check_env_specs

import rover_rl
from rover_rl import RoverEnv
from rover_rl.sims.ros2 import RobotLostError, Ros2Settings
from rover_rl.sims.ros2.dds import DdsTransport
from rover_rl.sims.ros2.messages import Clock, Odometry, Twist, Vector3
from tests.envs import transcription as contract
from tests.envs.contract.witness import check_witnessed, witness
from tests.sims.ros2.processes import Command, start_robot, until

pytestmark = [pytest.mark.ros2, pytest.mark.slow]

LIVE = Ros2Settings(reset="topic", reset_timeout=20.0, step_timeout=10.0)
SHORT_TIMEOUT = replace(LIVE, step_timeout=1.0)


def terminate(robot: Command | subprocess.Popen[str], number: int = signal.SIGTERM) -> int:
    robot.send_signal(number)
    return robot.wait(20)


@pytest.fixture
def robot(in_domain) -> Iterator[Command]:
    robot = start_robot(in_domain, "--world", "maze", "--rate", "4")
    yield robot
    robot.kill()


def make_env(backend: Ros2Settings = LIVE) -> RoverEnv:
    return RoverEnv(world_n="maze", backend=backend, seed=0, connection_check_timeout=60)


def drive(env: RoverEnv, steps: int) -> None:
    for _ in range(steps):
        env.step(env.rand_action())


@pytest.fixture(scope="module")
def real_time(domain) -> Iterator[dict[str, str]]:
    """Environment variables of a domain with a robot, which runs at half of real time so that no scan is missed."""
    variables = {**domain, "ROS_DOMAIN_ID": str(int(domain["ROS_DOMAIN_ID"]) + 2)}
    robot = start_robot({**os.environ, **variables}, "--world", "maze", "--rate", "0.5")
    yield variables
    terminate(robot)


@pytest.fixture
def with_robot(real_time, monkeypatch) -> None:
    """Puts this process in the domain of that robot."""
    for key, value in real_time.items():
        monkeypatch.setenv(key, value)


def test_the_environment_matches_its_specs(with_robot):
    env = rover_rl.make_env(world_n="maze", backend=LIVE, seed=0)
    check_env_specs(env, break_when_any_done="both")
    env.close()


def test_the_environment_fulfills_the_contract(with_robot):
    env = rover_rl.make_env(world_n="maze", backend=LIVE, seed=0, length=20)
    rng = np.random.default_rng(0)

    def wander(td, bare, k):
        return torch.from_numpy(rng.uniform(-1, 1, (1, 2))).float() * torch.tensor([1.0, math.pi])

    table = contract.WORLDS["maze"]
    seen = witness(env, (table.too_far_away_x, table.too_far_away_y), 50, wander, length=20)
    env.close()
    check_witnessed(seen, scans_may_be_missed=True)
    assert sum(verdict.truncated for verdict in seen.verdicts) == 2


def test_a_suspended_robot_may_resume(robot):
    env = make_env(SHORT_TIMEOUT)
    env.reset()
    robot.send_signal(signal.SIGSTOP)
    with pytest.raises(RobotLostError, match="a stop command was sent"):
        drive(env, steps=200)
    assert env.simulator.last_command == (0.0, 0.0)
    assert not env.robot_connected
    robot.send_signal(signal.SIGCONT)
    until(lambda: env.robot_connected)
    assert torch.isfinite(env.reset()["pose"]).all()
    drive(env, steps=3)
    env.close()


def test_the_robot_stops_without_commands_and_its_clock_is_regular(robot, domain):
    transport = DdsTransport("test", domain)
    clock: list[float] = []
    speeds: list[float] = []
    transport.subscribe("/clock", Clock, lambda message: clock.append(message.clock.sec + message.clock.nanosec * 1e-9))
    transport.subscribe("/odometry/wheels", Odometry, lambda message: speeds.append(message.twist.twist.linear.x))
    publish = transport.publisher("/cmd_vel", Twist, reliable=True)
    until(lambda: clock and speeds and transport.subscribers("/cmd_vel"))
    until(lambda: publish(Twist(Vector3(x=-0.5))) or speeds[-1] < -0.3)
    until(lambda: abs(speeds[-1]) < 0.01)
    transport.close()
    steps = [later - earlier for earlier, later in itertools.pairwise(clock)]
    assert steps == pytest.approx([0.05 * round(step / 0.05) for step in steps], abs=1e-6)
