from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from rover_rl import RoverEnv
from rover_rl.algos.deploy.drive_log import DriveLog, read_drives
from rover_rl.algos.deploy.driving import Moment, drive_to
from rover_rl.algos.driving import STOPPED, TIME_LIMIT, TOO_NEAR
from rover_rl.algos.policy.baselines import ScriptedPolicy
from rover_rl.algos.policy.runner import PolicyRunner
from rover_rl.cli import main
from rover_rl.sims.ros2.messages import LaserScan, Twist
from rover_rl.worlds import get_world
from tests.algos.policy.memories import CountingPolicy
from tests.sims.ros2.wire import SimulatedRobot, Wire

START = (-22.4, -24.7, 0.3)
GOAL = (-20.4, -24.2)


@pytest.fixture
def started(start_env) -> tuple[SimulatedRobot, RoverEnv]:
    return start_env(get_world("inspect"), START)


@pytest.fixture
def env(started) -> RoverEnv:
    return started[1]


def stopped(wire: Wire) -> bool:
    return wire.sent["/cmd_vel"][-3:] == [Twist()] * 3


def test_a_drive_ends_and_stops_at_its_goal(started, wire):
    robot, env = started
    moments: list[Moment] = []
    assert drive_to(env, ScriptedPolicy(), GOAL, watch=moments.append) == "goal"
    assert stopped(wire)
    assert torch.dist(robot.position[:2], torch.tensor(GOAL)) < 0.6
    assert moments[0].distance == pytest.approx(2.06, abs=0.1)
    assert moments[-1].distance <= 0.5
    assert max(moment.speed for moment in moments) > 0.3
    assert all(moment.latency >= 0 and moment.nearest > 0 for moment in moments)
    last = wire.sent["/cmd_vel"][-4]
    assert moments[-1].command == (last.linear.x, last.angular.z)


def test_an_obstacle_that_is_too_close_or_the_time_limit_ends_the_drive(env, wire):
    assert drive_to(env, ScriptedPolicy(), GOAL, clearance=20.0, patience=0.0) == TOO_NEAR
    assert stopped(wire)
    moments: list[Moment] = []
    assert drive_to(env, ScriptedPolicy(), GOAL, seconds=0.2, watch=moments.append) == TIME_LIMIT
    assert stopped(wire)
    assert [moment.seconds for moment in moments] == pytest.approx([0.05, 0.1, 0.15, 0.2])


def test_a_drive_begins_when_who_stands_at_the_rover_has_gone(env, wire):
    near = iter([0.15] * 40)

    def someone_stands_there(scan: LaserScan) -> LaserScan:
        return replace(scan, ranges=[next(near, scan.ranges[0]), *scan.ranges[1:]])

    wire.tamper["/scan"] = someone_stands_there
    moments: list[Moment] = []
    assert drive_to(env, ScriptedPolicy(), GOAL, clearance=0.2, watch=moments.append) == "goal"
    waiting = [moment for moment in moments if moment.seconds == 0]
    assert len(waiting) > 1
    assert {(moment.command, round(moment.nearest, 2)) for moment in waiting} == {((0.0, 0.0), 0.15)}
    assert all(moment.nearest > 0.2 for moment in moments[len(waiting) :])


def test_a_drive_that_is_stopped_while_it_waits_is_logged_as_stopped(env, wire, tmp_path):
    def interrupt(moment: Moment) -> None:
        assert moment.seconds == 0
        raise KeyboardInterrupt

    wire.tamper["/scan"] = lambda scan: replace(scan, ranges=[0.15, *scan.ranges[1:]])
    path = tmp_path / "drive.jsonl"
    with DriveLog(path, "inspect", "scripted", 60.0) as log, pytest.raises(KeyboardInterrupt):
        drive_to(env, ScriptedPolicy(), GOAL, clearance=0.2, watch=interrupt, log=log)
    assert stopped(wire)
    (drives,) = read_drives(path)
    assert drives.endings == [STOPPED]


def test_a_policy_decides_as_often_as_in_training_and_keeps_its_memory_from_goal_to_goal(env, wire):
    policy = CountingPolicy()
    runner = PolicyRunner(policy)

    def drive(driver: CountingPolicy | PolicyRunner) -> list[float]:
        moments: list[Moment] = []
        assert drive_to(env, driver, GOAL, seconds=0.5, watch=moments.append) == TIME_LIMIT
        return [round(100 * moment.command[0]) for moment in moments]

    # Two decisions of four steps of 50 ms, and one at the start of each drive.
    assert drive(runner) == [0] * 4 + [1] * 4 + [2] * 2
    assert drive(runner) == [3] * 4 + [4] * 4 + [5] * 2
    assert drive(policy) == [0] * 4 + [1] * 4 + [2] * 2
    assert stopped(wire)


def test_an_error_stops_the_rover(env, wire):
    def fail(now):
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        drive_to(env, fail, GOAL)
    assert stopped(wire)


def test_other_backends_are_rejected():
    env = RoverEnv(world_n="inspect")
    with pytest.raises(ValueError, match=r"only backend 'ros2' has a live rover, got BulletSimulator"):
        drive_to(env, ScriptedPolicy(), GOAL)
    env.close()


@pytest.fixture
def log(env, tmp_path) -> Path:
    """Log of three drives: one reached its goal, one was interrupted, one is incomplete."""
    path = tmp_path / "logs" / "drive.jsonl"

    def interrupt(moment: Moment) -> None:
        raise KeyboardInterrupt

    with DriveLog(path, "inspect", "scripted", 60.0) as log:
        drive_to(env, ScriptedPolicy(), GOAL, log=log)
        with pytest.raises(KeyboardInterrupt):
            drive_to(env, ScriptedPolicy(), (-23.0, -24.0), watch=interrupt, log=log)
        log.begin(env.rover_state, env.scan, (-23.0, -23.0))
    return path


def test_a_log_is_evaluated(log, env, tmp_path, capsys):
    (drives,) = read_drives(log)
    assert (drives.name, drives.seconds, drives.endings) == ("scripted", 60.0, ["goal", STOPPED])
    assert drives.success_rate == 0.5
    assert 0.25 < drives.metrics["spl"].value <= 0.5
    assert drives.trajectories[0].seconds > 1.5
    assert main(["evaluate", str(log), "--out", str(tmp_path / "out")]) == 0
    assert (tmp_path / "out" / "paths-drive.png").is_file()
    written = json.loads((tmp_path / "out" / "evaluation.json").read_text())
    assert written[0]["endings"] == {"goal": 1, STOPPED: 1}
    assert "scripted" in capsys.readouterr().out
    with log.open("a") as file:
        file.write('{"position": [1.0, ')  # an incomplete line
    with DriveLog(log, "inspect", "other", 60.0) as more:
        drive_to(env, ScriptedPolicy(), (-23.0, -24.0), clearance=20.0, patience=0.0, log=more)
    first, second = read_drives(log)  # policies are evaluated separately
    assert (first.endings, second.name, second.endings) == (["goal", STOPPED], "other", [TOO_NEAR])


def test_times_are_the_rovers(tmp_path):
    """With a lidar at 10 Hz, each step lasts two control steps of the evaluation."""
    path = tmp_path / "drive.jsonl"
    lines = [{"format": "rover_rl drive, version 1", "world": "inspect", "policy": "mine", "robot": "rover_zero"}]
    lines[0]["seconds"] = 60.0
    for step in range(11):
        pose = {"position": [-22.0 + 0.1 * step, -24.0, 0.0], "angles": [0.0, 0.0, 0.0], "ranges": [None]}
        events = {"collision": step == 5, "reached": False, "dt": 0.1, "command": [1.0, 0.0]}
        lines.append(pose | (events if step else {"goal": [-20.0, -24.0]}))
    lines.append({"ending": "stuck"})
    path.write_text("\n".join(map(json.dumps, lines)))
    (trajectory,) = read_drives(path)[0].trajectories
    assert trajectory.seconds == pytest.approx(1.0)
    assert trajectory.length == pytest.approx(1.0)
    assert trajectory.collision.nonzero().flatten().tolist() == [9]
