"""What a driver publishes beside its commands: plan, map, tracked movers and diagnostics."""

from __future__ import annotations

import math
import threading
from contextlib import closing
from dataclasses import replace

import numpy as np
import pytest
from mcap.reader import make_reader

from rover_rl import EnvConfig, Terrain, World
from rover_rl.algos.deploy.driving import drive_to
from rover_rl.algos.deploy.outputs import DriveOutputs
from rover_rl.algos.policy.baselines import ScriptedPolicy
from rover_rl.algos.policy.grid_planner import GridPlanner
from rover_rl.algos.policy.runner import sensors_for
from rover_rl.cli import main
from rover_rl.envs.config import GuardConfig
from rover_rl.worlds import get_world
from rover_rl.worlds.movers import Cylinder, Mover, Waypoints
from tests.sims.ros2.test_driving import AHEAD, BEYOND, COURSE, straight
from tests.sims.ros2.wire import SimulatedRobot


def drive(env, policy, goal=BEYOND, seconds=1.0) -> None:
    with closing(DriveOutputs(env)):
        drive_to(env, policy, goal, seconds=seconds)


@pytest.fixture
def planned(start_env, wire):
    """A drive with a planner to a goal behind a wall."""
    policy = GridPlanner()
    _, env = start_env(COURSE, (0.0, 0.0, 0.0), made_for=sensors_for(policy, policy.made_for))
    drive(env, policy)
    return env


def test_a_plan_leads_from_the_rover_around_what_it_has_seen(planned, wire):
    paths = [path for path in wire.sent["/plan"] if path.poses]
    assert len(paths) > 2
    path = paths[-1]
    assert path.header.frame_id == path.poses[0].header.frame_id == "world"
    places = [(pose.pose.position.x, pose.pose.position.y) for pose in path.poses]
    assert math.dist(places[0], (0.0, 0.0)) < 1.0
    # The wall ahead ends 4 m aside, and the path leads around its end to the goal.
    assert max(abs(y) for _, y in places) > 3.5
    assert places[-1] == pytest.approx(BEYOND, abs=1e-5)
    assert len({*places}) == len(places)
    first = path.poses[0].pose.orientation
    way = math.atan2(places[1][1] - places[0][1], places[1][0] - places[0][0])
    assert 2 * math.atan2(first.z, first.w) == pytest.approx(way, abs=1e-5)
    assert {"/plan", "/seen_map"} <= wire.latched


def test_a_map_has_the_walls_where_they_are(planned, wire):
    grid = wire.sent["/seen_map"][0]
    corner, cell = grid.info.origin.position, grid.info.resolution
    cells = np.array(grid.data).reshape(grid.info.height, grid.info.width)
    assert grid.header.frame_id == "world"

    def cost(x: float, y: float) -> int:
        return cells[int((y - corner.y) / cell), int((x - corner.x) / cell)]

    assert max(cost(AHEAD + 0.01, 0.0), cost(AHEAD - 0.01, 0.0)) == 100
    assert cost(AHEAD - 0.2, 0.0) in (66, 99)
    assert cost(1.5, 0.0) == 0
    assert cost(AHEAD + 1.0, 0.0) == -1, "behind the wall"


def test_a_policy_without_a_plan_and_a_map_publishes_only_diagnostics(start_env, wire):
    _, env = start_env(COURSE, (0.0, 0.0, 0.0))
    drive(env, ScriptedPolicy())
    assert {"/plan", "/seen_map", "/tracked_movers"}.isdisjoint(wire.sent)
    found = {status.name: status for each in wire.sent["/diagnostics"] for status in each.status if status.values}
    assert {"rover_rl: drive", "rover_rl: /scan", "rover_rl: /imu/data"} < {*found}
    times = {each.key: each.value for each in found["rover_rl: drive"].values}
    assert {*times} == {"decision_time", "longest_decision_time"}
    assert all(time.endswith(" ms") for time in times.values())
    scan = {each.key: each.value for each in found["rover_rl: /scan"].values}
    assert scan["age"].endswith(" s")
    assert scan["rate"].endswith(" Hz")
    assert (found["rover_rl: /scan"].level, found["rover_rl: drive"].message) == (0, "drives")


@pytest.mark.parametrize(
    ("changes", "view", "message"),
    [
        ({}, math.pi, "held: no beam covers the direction of travel"),
        ({"guard": GuardConfig(deceleration=1.0)}, 2 * math.pi, "the guard brakes before what is in the way"),
    ],
)
def test_diagnostics_say_why_the_rover_does_not_go_on(start_env, wire, changes, view, message):
    _, env = start_env(COURSE, (0.0, 0.0, 0.0), view=view, made_for=replace(EnvConfig(), **changes))
    backward = -1.0 if view == math.pi else 1.0
    with closing(DriveOutputs(env)):
        drive_to(env, straight(backward), BEYOND, seconds=4.0 if changes else 0.5, allow_unseen=True)
    # On a busy machine, the last one may be of a time without decisions.
    assert (1, message) in [(each.status[0].level, each.status[0].message) for each in wire.sent["/diagnostics"]]


def test_silent_topics_are_told_in_words(start_env, wire):
    _, env = start_env(COURSE, (0.0, 0.0, 0.0))
    with closing(DriveOutputs(env)):
        wire.now += 5.0
    found = {status.name: status for status in wire.sent["/diagnostics"][-1].status}
    assert found["rover_rl: drive"].message == "stopped: no usable scan arrives"
    assert (found["rover_rl: /scan"].level, found["rover_rl: /scan"].message) == (2, "the last message is 5.0 s old")


def test_tracked_movers_are_where_they_are(start_env, wire):
    walks = Mover(Waypoints([(0.0, 2.0, -3.0, 0.0), (6.0, 2.0, 3.0, 0.0)], repeat="once"), Cylinder(0.3, 1.7))
    world = World("walk", Terrain.flat((20, 20)), COURSE.obstacles, movers=[walks])
    _, env = start_env(world, (0.0, 0.0, 0.0), made_for=EnvConfig(sensors=("movers",)))
    drive(env, straight(0.0), seconds=3.0)
    shown = [array.markers for array in wire.sent["/tracked_movers"] if array.markers]
    assert shown
    place, arrow = shown[-1][:2]
    assert (place.ns, arrow.ns, place.header.frame_id) == ("movers", "velocities", "world")
    assert place.pose.position.x == pytest.approx(2.0, abs=0.3)
    start, end = arrow.points
    assert end.y - start.y == pytest.approx(1.0, abs=0.4)
    assert place.scale.x == pytest.approx(0.6, abs=0.3)


def test_outputs_that_hang_or_fail_do_not_delay_a_drive(start_env, wire, caplog):
    policy, hangs, moments = GridPlanner(), threading.Event(), []
    _, env = start_env(COURSE, (0.0, 0.0, 0.0), made_for=sensors_for(policy, policy.made_for))
    wire.tamper["/plan"] = lambda path: hangs.wait(60.0) and path
    wire.tamper["/diagnostics"] = lambda message: 1 / 0
    with closing(DriveOutputs(env)):
        assert drive_to(env, policy, BEYOND, seconds=2.0, watch=moments.append) == "time limit"
        assert len(moments) == 40
        assert not wire.sent["/plan"]
        hangs.set()
    assert wire.sent["/plan"]
    assert "/diagnostics: a message is not published" in caplog.text


def test_a_drive_with_remaps_and_a_namespace_publishes_and_records_all(wire, tmp_path, capsys):
    robot = SimulatedRobot(wire, get_world("maze"), (-3.0, 0.0, 0.7))
    for topic in ("/imu/data", "/odometry/wheels", "/rover/pose_array"):
        wire.tamper[topic] = lambda message, topic=topic: (
            [receive(message) for receive in wire.receivers[f"/robot1{topic}"]] and message
        )
    wire.tamper["/scan"] = lambda message: [receive(message) for receive in wire.receivers["/front/scan"]] and message
    path = tmp_path / "drive.mcap"
    remaps = ["--ros-args", "-r", "/scan:=/front/scan", "-r", "__ns:=/robot1", "-r", "plan:=way"]
    options = ["--world", "maze", "--goal", "9", "9", "--seconds", "0.5", "--bag", str(path)]
    assert main(["drive", "gridplanner", *options, *remaps]) == 1
    robot.rover.close()
    published = {"/robot1/way", "/robot1/seen_map", "/diagnostics", "/robot1/cmd_vel"}
    assert published <= {*wire.sent}
    with path.open("rb") as file:
        topics = {channel.topic for _, channel, _ in make_reader(file).iter_messages()}
    assert published | {"/front/scan", "/robot1/imu/data"} <= topics
