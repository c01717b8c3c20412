"""Reaction of a live rover to faulty sensors, limits and restarts, tested with a simulated rover on a course."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch
from tensordict import TensorDictBase

from rover_rl import EnvConfig, Randomization, RoverEnv, Terrain, World, box
from rover_rl.algos.deploy.drive_log import DriveLog
from rover_rl.algos.deploy.driving import Moment, drive_to
from rover_rl.algos.driving import RESTARTED, TIME_LIMIT
from rover_rl.algos.evaluation.trajectory import count_reversals
from rover_rl.algos.pretrained import load_pretrained
from rover_rl.sims.ros2 import RobotLostError
from rover_rl.sims.ros2.messages import Header, LaserScan, PoseArray, Twist
from tests.sims.ros2.wire import SimulatedRobot

AHEAD, BEHIND = 3.0, -1.0
"""Positions of the walls ahead of and behind the start, along x, m."""
COURSE = World(
    "course",
    Terrain.flat((20, 20)),
    obstacles=[box((AHEAD + 0.2, 0, 0.5), (0.4, 8, 1)), box((BEHIND - 0.2, 0, 0.5), (0.4, 8, 1))],
)
FRONT, TAIL = 0.265, 0.27
"""Length of the rover ahead of and behind its center, m."""


@pytest.fixture
def start(start_env) -> Callable[..., tuple[SimulatedRobot, RoverEnv]]:
    """Starts a robot on the course, and the environment that drives it."""
    return partial(start_env, COURSE, (0.0, 0.0, 0.0))


def straight(speed: float) -> Callable[[TensorDictBase], TensorDictBase]:
    return lambda now: now.set("action", torch.tensor([[speed, 0.0]]))


def blind_to_the_left(scan: LaserScan) -> LaserScan:
    """Loses the last six of 65 readings from -90 to 90 degrees."""
    ranges = scan.ranges.copy()
    ranges[-6:] = math.nan
    return replace(scan, ranges=ranges)


def all_nan(scan: LaserScan) -> LaserScan:
    return replace(scan, ranges=np.full_like(scan.ranges, math.nan))


def test_scans_that_become_unusable_stop_the_rover_before_a_wall(wire, start):
    robot, env = start()

    def watch(moment: Moment) -> None:
        if robot.driven[-1] > 1.0:
            wire.tamper["/scan"] = all_nan

    with pytest.raises(RobotLostError, match=r"/scan \(scan\): its messages cannot be used"):
        drive_to(env, straight(1.0), (6.0, 0.0), watch=watch)
    assert wire.sent["/cmd_vel"][-1] == Twist()
    assert 1.0 < max(robot.driven) < 1.6  # stopped within 0.25 s at 1 m/s


def test_a_robot_with_unusable_scans_is_not_driven(wire, start):
    wire.tamper["/scan"] = all_nan
    robot, env = start()
    with pytest.raises(RobotLostError, match=r"/scan \(scan\): its messages cannot be used"):
        drive_to(env, straight(1.0), (6.0, 0.0))
    assert all(twist == Twist() for twist in wire.sent["/cmd_vel"])
    assert max(robot.driven) < 0.01


def test_a_rover_with_a_forward_lidar_does_not_back_up_nor_drive_a_policy_with_a_wider_view(start):
    robot, env = start(view=math.pi)
    with pytest.raises(ValueError, match=r"the scan covers 18\d degrees, and the policy was trained with 360"):
        drive_to(env, straight(1.0), (6.0, 0.0))
    assert max(robot.driven) < 0.01
    # One that was trained with less drives it.
    backward, moments = straight(-1.0), list[Moment]()
    backward.made_for = EnvConfig(randomization=Randomization(lidar_view=(3.0, 6.0)))
    ending = drive_to(env, backward, (-6.0, 0.0), seconds=2.0, watch=moments.append)
    assert ending == TIME_LIMIT
    assert all(moment.held and moment.command[0] == 0.0 for moment in moments)
    assert min(robot.driven) > -0.01


def test_the_mask_follows_the_scan_of_a_live_rover(wire, start):
    wire.tamper["/scan"] = blind_to_the_left
    _, env = start(view=math.pi, made_for=EnvConfig(sensors=("lidar_mask",)), unseen_range=math.inf)
    observation = env.reset()
    mask, lidar = observation["lidar_mask"][0], observation["lidar"][0]
    # A reading is of four beams, from straight ahead to the left.
    assert mask.tolist() == [1.0] * 6 + [0.75] + [0.0] * 17 + [1.0] * 8
    assert (lidar[mask == 0] == 12.0).all()


def test_a_policy_with_a_forward_lidar_does_not_hit_a_wall(start):
    robot, env = start(view=math.pi)
    policy = load_pretrained("moon-sac").make_actor()
    drive_to(env, policy, (-6.0, 0.0), seconds=5.0, allow_unseen=True, clearance=0.2)
    assert min(robot.driven) - TAIL > BEHIND
    assert max(robot.driven) + FRONT < AHEAD


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
    _, env = start()

    def watch(moment: Moment) -> None:
        if moment.seconds > 0.4:
            wire.tamper[topic] = fault

    assert drive_to(env, straight(0.3), (6.0, 0.0), seconds=2.0, watch=watch) == RESTARTED
    assert f"the robot seems to have been restarted: {reason}" in caplog.text
    assert wire.sent["/cmd_vel"][-1] == Twist()


def test_commands_are_within_their_limits_and_reversals_are_logged(wire, start, tmp_path):
    _, env = start(max_speed=0.3, max_yaw_rate=1.5, max_acceleration=2.0, max_yaw_acceleration=20.0)
    steps = iter(range(10**6))

    def swerve(now: TensorDictBase) -> TensorDictBase:
        return now.set("action", torch.tensor([[1.0, 1.0 if next(steps) // 4 % 2 else -1.0]]))

    path = tmp_path / "drive.jsonl"
    with DriveLog(path, "maze", "swerve", 60.0) as log:
        drive_to(env, swerve, (6.0, 0.0), seconds=2.0, log=log)
    *twists, _, _, _ = wire.sent["/cmd_vel"]  # stop commands are exempt
    speeds, turns = np.array([(twist.linear.x, twist.angular.z) for twist in twists]).T
    assert speeds.max() == 0.3
    assert np.abs(turns).max() == 1.5
    assert np.abs(np.diff(speeds)).max() <= 2.0 * 0.05 + 1e-6
    assert np.abs(np.diff(turns)).max() <= 20.0 * 0.05 + 1e-6
    entries = [json.loads(line) for line in path.read_text().splitlines()]
    turns = [entry["command"][1] for entry in entries if "command" in entry]
    assert entries[-1]["reversals"] == count_reversals(turns) >= 5
