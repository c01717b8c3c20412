"""``rover-rl drive`` with ``rover-rl robot``, each in a process of its own."""

from __future__ import annotations

import math
import os
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

import pytest
import torch
from tensordict.nn import TensorDictModule
from torch import Tensor

from rover_rl.algos.deploy.drive_log import read_drives
from rover_rl.algos.evaluation.episodes import stored_episodes
from rover_rl.cli import main
from rover_rl.sims.ros2 import Ros2Settings
from rover_rl.sims.ros2.dds import DdsTransport
from rover_rl.sims.ros2.messages import Odometry, Point, PoseArray, Twist
from rover_rl.sims.ros2.pose_reset import Placer, TargetPose
from tests.sims.ros2.processes import Command, start_robot, until

pytestmark = [pytest.mark.ros2, pytest.mark.slow]

LONG = ("scripted", "--world", "maze", "--goal", "9", "9")
"""Arguments of a drive that does not end soon."""


@pytest.fixture(scope="module")
def environment(domain) -> dict[str, str]:
    """Environment variables of processes in the domain of the robot."""
    return {**os.environ, **domain, "ROS_DOMAIN_ID": str(int(domain["ROS_DOMAIN_ID"]) + 3)}


@pytest.fixture(scope="module")
def robot(environment) -> Iterator[Command]:
    robot = start_robot(environment, "--world", "maze")
    yield robot
    robot.kill()


class Observer:
    """Records commands, speed and position of the robot."""

    def __init__(self, environment: dict[str, str]) -> None:
        self.twists: list[Twist] = []
        self._received = 0.0
        self.speed = 0.0
        self.position = Point(math.inf)
        self.transport = DdsTransport("observer", environment)
        self.transport.subscribe("/cmd_vel", Twist, self._receive_twist)
        self.transport.subscribe("/odometry/wheels", Odometry, self._receive_odometry)
        self.transport.subscribe("/rover/pose_array", PoseArray, self._receive_pose)

    def is_silent(self) -> bool:
        """Whether no command has arrived for 0.3 s."""
        return time.monotonic() - self._received > 0.3

    def _receive_twist(self, twist: Twist) -> None:
        self.twists.append(twist)
        self._received = time.monotonic()

    def _receive_odometry(self, odometry: Odometry) -> None:
        self.speed = abs(odometry.twist.twist.linear.x)

    def _receive_pose(self, poses: PoseArray) -> None:
        self.position = poses.poses[0].position


@pytest.fixture
def observer(environment, robot) -> Iterator[Observer]:
    """Observer of the robot, which stands at a stored start without a wall nearby."""
    observer = Observer(environment)
    x, y, yaw = stored_episodes("maze").start[0].tolist()
    until(lambda: observer.position.x < math.inf)
    Placer(Ros2Settings(reset="topic"), "maze", observer.transport).place(TargetPose(x, y, 0.0, yaw))
    until(lambda: math.hypot(observer.position.x - x, observer.position.y - y) < 0.05 and observer.speed < 0.01)
    observer.twists.clear()
    yield observer
    observer.transport.close()


@pytest.fixture
def log(tmp_path) -> Path:
    return tmp_path / "drive.jsonl"


@pytest.fixture
def driving(environment, log) -> Iterator[Callable[..., Command]]:
    """Starts ``rover-rl drive`` with arguments and a log; kills all started processes at the end."""
    started: list[Command] = []

    def drive(*arguments: str) -> Command:
        started.append(Command(environment, "drive", *arguments, "--log", str(log)))
        return started[-1]

    yield drive
    for process in started:
        process.kill()


def test_drive_writes_a_log_that_evaluate_reads(driving, observer, log, tmp_path):
    goals = ("--random", "2", "--seconds", "1", "--clearance", "0")
    drive = driving("pretrained:anywhere", "--world", "maze", *goals)
    code = drive.wait(90)
    assert code in (0, 1), drive.output
    assert drive.output.count("goal 1,") == drive.output.count("goal 2,") == 1
    (drives,) = read_drives(log)
    endings = drives.endings
    assert len(endings) == 2
    assert (code == 0) == (endings == ["goal", "goal"])
    assert main(["evaluate", str(log), "--out", str(tmp_path)]) == 0
    assert (tmp_path / "paths-drive.png").is_file()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_stops_the_rover(driving, observer, number):
    drive = driving(*LONG)
    until(lambda: observer.speed > 0.1)
    drive.send_signal(number)
    assert drive.wait(20) == 130, drive.output
    assert observer.twists[-1] == observer.twists[-2] == Twist()
    until(lambda: observer.speed < 0.01, seconds=5)


def test_an_interrupt_suppressed_by_a_library_stops_the_rover_at_the_next_step(environment, observer, log, monkeypatch):
    def steer(lidar: Tensor, target: Tensor) -> Tensor:
        if observer.speed > 0.1:
            with suppress(KeyboardInterrupt):
                signal.raise_signal(signal.SIGINT)
        return torch.tensor([[1.0, 0.0]])

    monkeypatch.setattr(
        "rover_rl.algos.policy.baselines.ScriptedPolicy",
        lambda: TensorDictModule(steer, in_keys=["lidar", "target"], out_keys=["action"]),
    )
    for key, value in environment.items():
        monkeypatch.setenv(key, value)
    before = signal.getsignal(signal.SIGINT)
    assert main(["drive", *LONG, "--log", str(log)]) == 130
    assert signal.getsignal(signal.SIGINT) is before
    assert observer.twists[-1] == observer.twists[-2] == Twist()
    until(lambda: observer.speed < 0.01, seconds=5)


def test_a_dry_run_sends_nothing(driving, observer):
    drive = driving(*LONG, "--dry-run", "--seconds", "1")
    assert drive.wait(60) == 1, drive.output
    assert drive.output.count("m/s") >= 2 * 5
    assert "goal 1, 9.00 9.00: time limit" in drive.output
    assert not observer.twists
    assert observer.speed < 0.01


def test_silent_sensors_stop_the_rover(driving, robot, observer, log):
    drive = driving(*LONG)
    until(lambda: observer.speed > 0.1)
    robot.send_signal(signal.SIGSTOP)
    try:
        code = drive.wait(30)
    finally:
        robot.send_signal(signal.SIGCONT)
    assert code == 2, drive.output
    assert "rover-rl: lost the robot: " in drive.output
    assert read_drives(log)[0].endings == ["stopped"]
    until(lambda: observer.speed < 0.01)


def test_the_watchdog_stops_the_rover_if_the_process_is_killed(driving, observer):
    drive = driving(*LONG)
    until(lambda: observer.speed > 0.1)
    drive.kill()
    observer.twists.clear()
    until(lambda: observer.twists.count(Twist()) > 10, seconds=5)
    assert observer.twists[-1] == Twist()
    # The watchdog sends stop commands for two seconds, also to the rover of the next test.
    until(observer.is_silent)


def test_drive_without_a_robot_reports_an_error(log, domain):
    alone = {**os.environ, **domain, "ROS_DOMAIN_ID": str(int(domain["ROS_DOMAIN_ID"]) + 4)}
    drive = Command(alone, "drive", *LONG, "--timeout", "0.2", "--log", str(log))
    assert drive.wait(60) == 2, drive.output
    assert "rover-rl: lost the robot: /scan (scan): no message has arrived yet" in drive.output


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("drive scripted --goal 1 1", "say which --world"),
        ("drive random --world maze --goal 1 1", "cannot drive a live rover"),
        ("drive scripted --world maze", "say where to"),
        ("drive scripted --world maze --goal nan 1", "--goal must be finite numbers, got nan 1"),
        (
            "drive scripted --world maze --goal 1 1 --goal 40 0",
            "the goal 40 0 is outside of the bounds of maze: x from -30 to 30 m, y from -30 to 30 m; name the --world",
        ),
        ("drive scripted --goal 1 1 --clearance -1", "clearance must be at least 0 and at most 1e+30, got -1.0"),
        ("drive scripted --goal 1 1 --timeout nan", "timeout must be at least 0 and at most 1e+06, got nan"),
        ("drive scripted --goal 1 1 --lidar-yaw nan", "lidar_yaw must be a finite angle in rad, got nan"),
        ("drive scripted --goal 1 1 --max-speed 0", "max_speed must be positive and finite, got 0"),
        ("drive scripted --world maze --goals goals.csv", "goals.csv must have two numbers a line"),
        ("robot --rate 0", "rate must be positive and at most 1000, got 0"),
        ("robot --lidar-beams 0", "lidar_beams must be at least 1 and at most 16383, got 0"),
        ("robot --lidar-view 0", "lidar_view must be positive and at most 360, got 0"),
    ],
)
def test_invalid_options_are_rejected_before_connecting(arguments, message, capsys, tmp_path, monkeypatch):
    for part in ("sims.ros2.commands.Watchdog", "envs.rover.RoverEnv", "sims.ros2.transport.make_transport"):
        monkeypatch.setattr(f"rover_rl.{part}", None)
    monkeypatch.chdir(tmp_path)
    Path("goals.csv").write_text("1.0, 2.0\nx, y\n")
    assert main(arguments.split()) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
