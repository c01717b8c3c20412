"""Drives with a simulated rover on a course: endings, limits, faulty sensors, and bags."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch
from tensordict import TensorDictBase

from rover_rl import ActionConfig, EnvConfig, Randomization, RoverEnv, Termination, Terrain, World, box
from rover_rl.algos.deploy.bags import DriveBag
from rover_rl.algos.deploy.driving import Moment, drive_to
from rover_rl.algos.deploy.recorded_drives import read_drives
from rover_rl.algos.driving import RESTARTED, STOPPED, TIME_LIMIT, TOO_NEAR
from rover_rl.algos.evaluation.trajectory import count_reversals
from rover_rl.algos.policy.baselines import ScriptedPolicy
from rover_rl.algos.policy.runner import PolicyRunner
from rover_rl.algos.pretrained import load_pretrained
from rover_rl.sims.ros2 import RobotLostError
from rover_rl.sims.ros2.messages import Header, LaserScan, PoseArray, Twist
from tests.algos.policy.memories import CountingPolicy
from tests.sims.ros2.wire import SimulatedRobot, Wire

AHEAD, BEHIND = 3.0, -1.0  # positions of the walls ahead of and behind the start, along x, m
WALLS = [box((AHEAD + 0.2, 0, 0.5), (0.4, 8, 1)), box((BEHIND - 0.2, 0, 0.5), (0.4, 8, 1))]
COURSE = World("course", Terrain.flat((20, 20)), obstacles=WALLS)
FRONT, TAIL = 0.265, 0.27  # length of the rover ahead of and behind its center, m
GOAL, BEYOND = (1.5, 0.3), (6.0, 0.0)  # a goal near the start, and one behind the wall


@pytest.fixture
def start(start_env) -> Callable[..., tuple[SimulatedRobot, RoverEnv]]:
    """Starts a robot on the course, and the environment that drives it."""
    return partial(start_env, COURSE, (0.0, 0.0, 0.0))


@pytest.fixture
def started(start) -> tuple[SimulatedRobot, RoverEnv]:
    return start()


@pytest.fixture
def env(started) -> RoverEnv:
    return started[1]


def straight(speed: float) -> Callable[[TensorDictBase], TensorDictBase]:
    return lambda now: now.set("action", torch.tensor([[speed, 0.0]]))


def stopped(wire: Wire) -> bool:
    return wire.sent["/cmd_vel"][-3:] == [Twist()] * 3


def interrupt(moment: Moment) -> None:
    raise KeyboardInterrupt


def all_nan(scan: LaserScan) -> LaserScan:
    return replace(scan, ranges=np.full_like(scan.ranges, math.nan))


def test_a_drive_ends_and_stops_at_its_goal(started, wire):
    robot, env = started
    moments: list[Moment] = []
    assert drive_to(env, ScriptedPolicy(), GOAL, watch=moments.append) == "goal"
    assert stopped(wire)
    assert torch.dist(robot.position[:2], torch.tensor(GOAL)) < 0.6
    assert moments[0].distance == pytest.approx(math.hypot(*GOAL), abs=0.1)
    assert moments[-1].distance <= 0.5
    assert max(moment.speed for moment in moments) > 0.3
    assert all(moment.nearest > 0 for moment in moments)
    last = wire.sent["/cmd_vel"][-4]
    assert moments[-1].command == (last.linear.x, last.angular.z)


class Ahead(Termination):
    """Ends a drive half a meter ahead of its start."""

    name = "half_a_meter"

    def ends(self, outcome, observation):
        return observation["pose"][:, :1] > 0.5


def test_a_live_rover_has_the_action_and_the_terminations_of_its_environment(start, wire):
    made_for = EnvConfig(action=ActionConfig(kind="twist"), terminate=(Ahead,))
    robot, env = start(made_for=made_for)
    moments: list[Moment] = []
    policy = lambda now: now.set("action", torch.tensor([[0.5, 0.2]]))  # noqa: E731
    assert drive_to(env, policy, GOAL, watch=moments.append) == "half a meter"
    assert stopped(wire)
    assert moments[5].command == pytest.approx((0.5, 0.2))
    assert 0.4 < robot.position[0] < 0.7


def test_an_obstacle_that_is_too_close_or_the_time_limit_ends_the_drive(env, wire):
    assert drive_to(env, ScriptedPolicy(), GOAL, clearance=20.0, patience=0.0) == TOO_NEAR
    assert stopped(wire)
    moments: list[Moment] = []
    assert drive_to(env, ScriptedPolicy(), GOAL, seconds=0.2, watch=moments.append) == TIME_LIMIT
    assert stopped(wire)
    assert [moment.seconds for moment in moments] == pytest.approx([0.05, 0.1, 0.15, 0.2])


def test_a_drive_begins_when_who_stands_at_the_rover_has_gone_and_may_be_stopped_before(env, wire, tmp_path):
    near = iter([0.15] * 80)
    wire.tamper["/scan"] = lambda scan: replace(scan, ranges=[next(near, scan.ranges[0]), *scan.ranges[1:]])
    path, moments = tmp_path / "drive.mcap", list[Moment]()
    with DriveBag(path, "maze", "scripted", 60.0) as bag, pytest.raises(KeyboardInterrupt):
        drive_to(env, ScriptedPolicy(), GOAL, clearance=0.2, watch=interrupt, bag=bag)
    assert stopped(wire)
    assert [drive.ending for drive in read_drives(path).drives] == [STOPPED]
    assert drive_to(env, ScriptedPolicy(), GOAL, clearance=0.2, watch=moments.append) == "goal"
    waiting = [moment for moment in moments if moment.seconds == 0]
    assert len(waiting) > 1
    assert {(moment.command, round(moment.nearest, 2)) for moment in waiting} == {((0.0, 0.0), 0.15)}
    assert all(moment.nearest > 0.2 for moment in moments[len(waiting) :])


def test_a_policy_decides_as_often_as_in_training_and_keeps_its_memory_from_goal_to_goal(env):
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


def test_an_error_stops_the_rover(env, wire):
    def fail(now):
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        drive_to(env, fail, GOAL)
    assert stopped(wire)


def test_other_backends_are_rejected():
    env = RoverEnv(world_n=COURSE, backend="warp")
    with pytest.raises(ValueError, match=r"only backend 'ros2' has a live rover, got WarpSimulator"):
        drive_to(env, ScriptedPolicy(), GOAL)
    env.close()


def test_unusable_scans_stop_the_rover_before_a_wall_and_none_is_driven_with_them(wire, started):
    robot, env = started

    def watch(moment: Moment) -> None:
        if robot.driven[-1] > 1.0:
            wire.tamper["/scan"] = all_nan

    for _ in range(2):
        with pytest.raises(RobotLostError, match=r"/scan \(scan\): its messages cannot be used"):
            drive_to(env, straight(1.0), BEYOND, watch=watch)
        assert stopped(wire)
        assert 1.0 < max(robot.driven) < 1.6  # stopped within 0.25 s at 1 m/s


def test_a_rover_with_a_forward_lidar_does_not_back_up_nor_drive_a_policy_with_a_wider_view(start):
    robot, env = start(view=math.pi)
    with pytest.raises(ValueError, match=r"the scan covers 18\d degrees, and the policy was trained with 360"):
        drive_to(env, straight(1.0), BEYOND)
    assert max(robot.driven) < 0.01
    # One that was trained with less drives it.
    backward, moments = straight(-1.0), list[Moment]()
    backward.made_for = EnvConfig(randomization=Randomization(lidar_view=(3.0, 6.0)))
    assert drive_to(env, backward, (-6.0, 0.0), seconds=1.0, watch=moments.append) == TIME_LIMIT
    assert all(moment.held and moment.command[0] == 0.0 for moment in moments)
    assert min(robot.driven) > -0.01
    drive_to(env, load_pretrained("moon-sac").make_actor(), (-6.0, 0.0), seconds=4.0, allow_unseen=True, clearance=0.2)
    assert min(robot.driven) > BEHIND + TAIL
    assert max(robot.driven) < AHEAD - FRONT


def test_the_mask_follows_the_scan_of_a_live_rover(wire, start):
    def blind_to_the_left(scan: LaserScan) -> LaserScan:
        """Loses the last six of 65 readings from -90 to 90 degrees."""
        return replace(scan, ranges=np.append(scan.ranges[:-6], np.full(6, np.nan, np.float32)))

    wire.tamper["/scan"] = blind_to_the_left
    _, env = start(view=math.pi, made_for=EnvConfig(sensors=("lidar_mask",)), unseen_range=math.inf)
    observation = env.reset()
    mask, lidar = observation["lidar_mask"][0], observation["lidar"][0]
    # A reading is of four beams, from straight ahead to the left.
    assert mask.tolist() == [1.0] * 6 + [0.75] + [0.0] * 17 + [1.0] * 8
    assert (lidar[mask == 0] == 12.0).all()


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
def test_a_restart_of_the_robot_ends_the_drive(wire, env, caplog, topic, fault, reason):
    def watch(moment: Moment) -> None:
        if moment.seconds > 0.4:
            wire.tamper[topic] = fault

    assert drive_to(env, straight(0.3), BEYOND, seconds=2.0, watch=watch) == RESTARTED
    assert f"the robot seems to have been restarted: {reason}" in caplog.text
    assert stopped(wire)


def test_commands_are_within_their_limits_and_reversals_are_recorded(wire, start, tmp_path):
    _, env = start(max_speed=0.3, max_yaw_rate=1.5, max_acceleration=2.0, max_yaw_acceleration=20.0)
    steps = iter(range(10**6))

    def swerve(now: TensorDictBase) -> TensorDictBase:
        return now.set("action", torch.tensor([[1.0, 1.0 if next(steps) // 4 % 2 else -1.0]]))

    path = tmp_path / "drive.mcap"
    with DriveBag(path, "maze", "swerve", 60.0) as bag:
        drive_to(env, swerve, BEYOND, seconds=2.0, bag=bag)
    *twists, _, _, _ = wire.sent["/cmd_vel"]  # stop commands are exempt
    speeds, turns = np.array([(twist.linear.x, twist.angular.z) for twist in twists]).T
    assert (speeds.max(), np.abs(turns).max()) == (0.3, 1.5)
    assert np.abs(np.diff(speeds)).max() <= 2.0 * 0.05 + 1e-6
    assert np.abs(np.diff(turns)).max() <= 20.0 * 0.05 + 1e-6
    (drive,) = read_drives(path).drives
    assert drive.trajectory().reversals == count_reversals(turns.tolist()) >= 5
