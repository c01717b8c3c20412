"""Reaction of a live rover to faulty sensors, limits and restarts, tested with a simulated rover on a course."""

from __future__ import annotations

import json
import math
import threading
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
import pytest
import torch
from tensordict import TensorDictBase

from rover_rl import RoverEnv, Terrain, World, box
from rover_rl.algos.deploy.drive_log import DriveLog
from rover_rl.algos.deploy.driving import Moment, drive_to
from rover_rl.algos.evaluation.metrics import RESTARTED, TIME_LIMIT, count_reversals
from rover_rl.algos.pretrained import load_pretrained
from rover_rl.sims import make_simulator
from rover_rl.sims.free_space import rest_on_ground
from rover_rl.sims.robots import get_robot
from rover_rl.sims.ros2 import RobotLostError, Ros2Settings
from rover_rl.sims.ros2.messages import Header, LaserScan, PoseArray, Twist
from rover_rl.sims.ros2.robot import RobotNode
from tests.sims.ros2.wire import Wire

AHEAD, BEHIND = 3.0, -1.0
"""Positions of the walls ahead of and behind the start, along x, m."""
COURSE = World(
    "course",
    Terrain.flat((20, 20)),
    obstacles=[box((AHEAD + 0.2, 0, 0.5), (0.4, 8, 1)), box((BEHIND - 0.2, 0, 0.5), (0.4, 8, 1))],
)
FRONT, TAIL = 0.265, 0.27
"""Length of the rover ahead of and behind its center, m."""


class Robot:
    """A rover on the course that steps at each command, or after 0.2 s without one."""

    def __init__(self, wire: Wire, view: float = 2 * math.pi, yaw: float = 0.0) -> None:
        kind = get_robot("rover_zero")
        self._simulator = make_simulator("bullet", worlds=[COURSE], robot=kind)
        scanner, start = self._simulator.scanner(128), (0.0, 0.0, yaw)
        self.node = RobotNode(self._simulator, scanner, wire, COURSE, kind.lidar_range, start=start, view=view)
        self.driven: list[float] = []
        self._commanded, self._stop = threading.Event(), threading.Event()
        wire.subscribe("/cmd_vel", Twist, lambda twist: self._commanded.set())
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        while not self._stop.is_set():
            self._commanded.wait(0.2)
            self._commanded.clear()
            self.node.step()
            self.driven.append(self.node.pose[0])

    def end(self) -> None:
        self._stop.set()
        self._thread.join()
        self._simulator.close()


@pytest.fixture
def start(wire: Wire) -> Iterator[Callable[..., RoverEnv]]:
    """Makes the environment that drives a robot; closes both at the end."""
    started: list[tuple[Robot, RoverEnv]] = []

    def make(robot: Robot, **settings: object) -> RoverEnv:
        backend = replace(Ros2Settings(reset="none", settle=0.05, step_timeout=0.5), **settings)
        env = RoverEnv(world_n=COURSE, length=10**9, backend=backend, end_on_goal=True, seed=0)
        started.append((robot, env))
        return env

    yield make
    for robot, env in started:
        env.close()
        robot.end()


def straight(speed: float) -> Callable[[TensorDictBase], TensorDictBase]:
    return lambda now: now.set("action", torch.tensor([[speed, 0.0]]))


def all_nan(scan: LaserScan) -> LaserScan:
    return replace(scan, ranges=np.full_like(scan.ranges, math.nan))


def seven_readings(scan: LaserScan) -> LaserScan:
    return replace(scan, ranges=scan.ranges[:7])


def no_increment(scan: LaserScan) -> LaserScan:
    return replace(scan, angle_increment=0.0)


FAULTS = pytest.mark.parametrize("fault", [all_nan, seven_readings, no_increment])


@FAULTS
def test_scans_that_become_unusable_stop_the_rover_before_a_wall(wire, start, fault):
    robot = Robot(wire)
    env = start(robot)

    def watch(moment: Moment) -> None:
        if robot.node.pose[0] > 1.0:
            wire.tamper["/scan"] = fault

    with pytest.raises(RobotLostError, match=r"/scan \(scan\): its messages cannot be used"):
        drive_to(env, straight(1.0), (6.0, 0.0), watch=watch)
    assert wire.sent["/cmd_vel"][-1] == Twist()
    assert max(robot.driven) < 1.6  # stopped within 0.25 s at 1 m/s


@FAULTS
def test_a_robot_with_unusable_scans_is_not_driven(wire, start, fault):
    wire.tamper["/scan"] = fault
    robot = Robot(wire)
    env = start(robot)
    with pytest.raises(RobotLostError, match=r"/scan \(scan\): its messages cannot be used"):
        drive_to(env, straight(1.0), (6.0, 0.0))
    assert set(map(repr, wire.sent.get("/cmd_vel", []))) <= {repr(Twist())}
    # It may be given up before its first step.
    assert max(robot.driven, default=0.0) < 0.01


def test_a_lidar_with_a_narrower_view_than_the_policys_is_rejected(wire, start):
    robot = Robot(wire, view=math.pi)
    env = start(robot)
    with pytest.raises(ValueError, match=r"the scan covers 18\d degrees, and the policy was trained with 360"):
        drive_to(env, straight(1.0), (6.0, 0.0))
    assert max(robot.driven, default=0.0) < 0.01


def test_a_rover_with_a_forward_lidar_does_not_back_up(wire, start):
    robot = Robot(wire, view=math.pi)
    env, moments = start(robot), list[Moment]()
    ending = drive_to(env, straight(-1.0), (-6.0, 0.0), seconds=2.0, allow_unseen=True, watch=moments.append)
    assert ending == TIME_LIMIT
    assert all(moment.held and moment.command[0] == 0.0 for moment in moments)
    assert min(robot.driven) > -0.01


def test_a_policy_with_a_forward_lidar_does_not_hit_a_wall(wire, start):
    robot = Robot(wire, view=math.pi)
    policy = load_pretrained("moon-sac").make_actor()
    drive_to(start(robot, step_timeout=2.0), policy, (-6.0, 0.0), seconds=5.0, allow_unseen=True, clearance=0.2)
    assert min(robot.driven) - TAIL > BEHIND
    assert max(robot.driven) + FRONT < AHEAD


def test_a_rover_backs_up_if_its_lidar_sees_behind(wire, start):
    robot = Robot(wire)
    drive_to(start(robot, step_timeout=2.0), straight(-0.2), (-6.0, 0.0), seconds=1.0)
    assert min(robot.driven) < -0.1


def clock_went_back(scan: LaserScan) -> LaserScan:
    return replace(scan, header=Header(replace(scan.header.stamp, sec=scan.header.stamp.sec - 1000)))


def pose_jumped(poses: PoseArray) -> PoseArray:
    (pose,) = poses.poses
    return replace(poses, poses=[replace(pose, position=replace(pose.position, y=pose.position.y + 4.0))])


@pytest.mark.parametrize(
    ("topic", "fault", "reason"),
    [
        ("/scan", clock_went_back, "its clock went back by"),
        ("/rover/pose_array", pose_jumped, "its pose jumped by 4.0 m"),
    ],
)
def test_a_restart_of_the_robot_ends_the_drive(wire, start, caplog, topic, fault, reason):
    robot = Robot(wire)
    env = start(robot)

    def watch(moment: Moment) -> None:
        if moment.seconds > 0.4:
            wire.tamper[topic] = fault

    assert drive_to(env, straight(0.3), (6.0, 0.0), seconds=2.0, watch=watch) == RESTARTED
    assert f"the robot seems to have been restarted: {reason}" in caplog.text
    assert wire.sent["/cmd_vel"][-1] == Twist()


def test_commands_are_within_their_limits_and_reversals_are_logged(wire, start, tmp_path):
    robot, steps = Robot(wire), iter(range(10**6))
    env = start(
        robot, step_timeout=2.0, max_speed=0.3, max_yaw_rate=1.5, max_acceleration=2.0, max_yaw_acceleration=20.0
    )

    def swerve(now: TensorDictBase) -> TensorDictBase:
        return now.set("action", torch.tensor([[1.0, 1.0 if next(steps) // 4 % 2 else -1.0]]))

    path = tmp_path / "drive.jsonl"
    with DriveLog(path, "maze", "swerve", 60.0) as log:
        drive_to(env, swerve, (6.0, 0.0), seconds=2.0, log=log)
    twists = wire.sent["/cmd_vel"]
    assert max(abs(twist.linear.x) for twist in twists) == 0.3
    assert max(abs(twist.angular.z) for twist in twists) == 1.5
    entries = [json.loads(line) for line in path.read_text().splitlines()]
    turns = [entry["command"][1] for entry in entries if "command" in entry]
    assert entries[-1]["reversals"] == count_reversals(turns) >= 5


def test_the_walls_of_the_course_are_where_the_constants_say():
    position, _ = rest_on_ground(COURSE, get_robot("rover_zero"), torch.zeros(1, 3))
    assert abs(position[0, 2].item()) < 0.01
    assert COURSE.inside(torch.tensor([[AHEAD + 0.01, 0.0, 0.5], [BEHIND - 0.01, 0.0, 0.5]])).all()
    assert not COURSE.inside(torch.tensor([[AHEAD - 0.01, 0.0, 0.5], [BEHIND + 0.01, 0.0, 0.5]])).any()
