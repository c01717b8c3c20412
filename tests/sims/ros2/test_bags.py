"""Bags of drives: what is recorded, what is read of files that are torn or of others, and what is refused."""

from __future__ import annotations

import errno
import json
import math
import os
import threading
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from functools import partial
from itertools import cycle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from mcap.reader import make_reader
from mcap.writer import Writer as McapWriter
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as BagWriter

from rover_rl import RoverEnv
from rover_rl.algos.deploy.bags import DriveBag
from rover_rl.algos.deploy.driving import Moment, drive_to
from rover_rl.algos.deploy.recorded_drives import (
    RecordedDrive,
    Sample,
    evaluate_drives,
    read_drives,
    recording_of_drive,
)
from rover_rl.algos.driving import STOPPED, TIME_LIMIT, TOO_NEAR
from rover_rl.algos.policy.baselines import ScriptedPolicy
from rover_rl.cli import main
from rover_rl.sims.ros2 import messages as ros
from rover_rl.sims.ros2.settings import BagTopics
from tests.sims.ros2.processes import until
from tests.sims.ros2.test_driving import AHEAD, COURSE, GOAL, interrupt, straight
from tests.sims.ros2.wire import SimulatedRobot

TAIL = 6000  # length of the end of a bag that is torn off, bytes
NANO = 1_000_000_000
FORWARD = BagTopics(pose="/pose", lidar_yaw=0.0)


@pytest.fixture
def env(start_env: Callable[..., tuple[SimulatedRobot, RoverEnv]]) -> RoverEnv:
    return start_env(COURSE, (0.0, 0.0, 0.0))[1]


def record(path: Path, env: RoverEnv, *drives: dict[str, Any], policy: str = "scripted", **about: Any) -> None:
    """Records drives to GOAL, each with the given options."""
    with DriveBag(path, "maze", policy, 60.0, **about) as bag:
        env.simulator.tap(bag.add)
        for options in drives:
            with suppress(KeyboardInterrupt):
                drive_to(env, **{"policy": ScriptedPolicy(), "goal": GOAL, "bag": bag, **options})


def messages_in(path: Path) -> dict[str, list[Any]]:
    """Messages of a bag by topic, as the indexed reader of mcap and the definitions in the file tell them."""
    found: dict[str, list[Any]] = {}
    with path.open("rb") as file:
        for schema, channel, message in make_reader(file).iter_messages():
            found.setdefault(channel.topic, []).append(ros.TYPES.deserialize_cdr(message.data, schema.name))
    return found


def test_figures_of_a_bag_are_those_of_the_drive(env, tmp_path):
    path, moments = tmp_path / "bags" / "drive.mcap", list[Moment]()
    states: list[tuple[Any, Any]] = []

    def watch(moment: Moment) -> None:
        moments.append(moment)
        states.append((env.rover_state.clone(), env.scan.clone()))

    record(path, env, {"watch": watch})
    steps = messages_in(path)["/rover_rl/step"][1:]
    assert len(steps) == len(moments) > 20
    for step, moment, (state, scan) in zip(steps, moments, states, strict=True):
        assert (step.command.linear.x, step.command.angular.z) == moment.command
        assert (step.latency, step.distance, step.held) == (moment.latency, moment.distance, moment.held)
        assert [step.pose.position.x, step.pose.position.y, step.pose.position.z] == state.position[0].tolist()
        np.testing.assert_array_equal(step.ranges, scan[0].numpy())
    (drive,) = read_drives(path).drives
    assert (drive.ending, drive.goal) == ("goal", GOAL)
    assert drive.times[1:] == [moment.seconds for moment in moments]
    assert [sample.reached for sample in drive.samples] == [False] * len(moments) + [True]
    assert drive.trajectory().length == pytest.approx(
        sum(math.dist(a.position[:2], b.position[:2]) for a, b in zip(drive.samples, drive.samples[1:], strict=False)),
        abs=1e-5,
    )


def test_bags_are_evaluated_together(env, tmp_path, capsys):
    """One drive has reached its goal, one was interrupted, one is in another bag, and one is of another policy."""
    first, second, other = (tmp_path / f"{name}.mcap" for name in ("first", "second", "other"))
    record(first, env, {}, {"goal": (0.0, 2.0), "watch": interrupt})
    record(second, env, {"goal": (0.0, 2.0), "seconds": 0.2})
    record(other, env, {"goal": (0.0, 2.0), "clearance": 20.0, "patience": 0.0}, policy="other")
    drives, others = evaluate_drives([read_drives(path) for path in (first, second, other)])
    assert (drives.name, drives.seconds, drives.endings) == ("scripted", 60.0, ["goal", STOPPED, TIME_LIMIT])
    assert (others.name, others.endings) == ("other", [TOO_NEAR])
    assert 0.16 < drives.metrics["spl"].value <= 1 / 3
    for command in ("evaluate", "compare"):
        out = tmp_path / command
        assert main([command, str(first), str(other), "--out", str(out)]) == 0
        assert (out / "paths-drives-1.png").is_file()
        written = json.loads((out / "evaluation.json").read_text())
        assert written[0]["endings"] == {"goal": 1, STOPPED: 1}


def test_runs_are_not_compared_with_bags(tmp_path, failed):
    assert "runs/ppo is no bag, and lab.mcap is one" in failed("compare", "lab.mcap", "runs/ppo")


def test_others_open_a_bag_with_standard_types(env, wire, tmp_path):
    path = tmp_path / "drive.mcap"
    record(path, env, {"seconds": 0.5})
    with path.open("rb") as file:
        reader = make_reader(file)
        summary, about = reader.get_summary(), [*reader.iter_metadata()]
        assert reader.get_header().profile == "ros2"
    assert {channel.message_encoding for channel in summary.channels.values()} == {"cdr"}
    assert {schema.encoding for schema in summary.schemas.values()} == {"ros2msg"}
    assert about[0].metadata == {"world": "maze", "policy": "scripted", "robot": "rover_zero", "seconds": "60.0"}
    with AnyReader([path]) as others:
        types = {connection.topic: connection.msgtype for connection in others.connections}
        read = [(conn.topic, others.deserialize(data, conn.msgtype)) for conn, _, data in others.messages()]
    assert types == {
        "/clock": "rosgraph_msgs/msg/Clock",
        "/scan": "sensor_msgs/msg/LaserScan",
        "/imu/data": "sensor_msgs/msg/Imu",
        "/odometry/wheels": "nav_msgs/msg/Odometry",
        "/rover/pose_array": "geometry_msgs/msg/PoseArray",
        "/cmd_vel": "geometry_msgs/msg/Twist",
        "/rover_rl/goal": "geometry_msgs/msg/PoseStamped",
        "/rover_rl/step": "rover_rl_msgs/msg/DriveStep",
        "/rover_rl/ending": "std_msgs/msg/String",
    }
    sent = [twist.linear.x for twist in wire.sent["/cmd_vel"]]
    assert [message.linear.x for topic, message in read if topic == "/cmd_vel"] == sent
    assert [message.data for topic, message in read if topic == "/rover_rl/ending"] == [TIME_LIMIT]


def test_a_bag_that_is_not_closed_or_torn_is_read_up_to_its_last_whole_message(env, tmp_path):
    path, torn = tmp_path / "drive.mcap", tmp_path / "torn.mcap"
    with DriveBag(path, "maze", "scripted", 60.0) as bag:
        drive_to(env, straight(0.3), (6.0, 0.0), seconds=0.5, bag=bag)
        until(lambda: path.stat().st_size and b"time limit" in path.read_bytes())
        assert read_drives(path).drives[0].ending == TIME_LIMIT
        content = path.read_bytes()
    samples = [len(read_drives(path).drives[0].samples)]
    for size in range(len(content), len(content) - TAIL, -10):
        torn.write_bytes(content[:size])
        (drive,) = read_drives(torn).drives
        samples.append(len(drive.samples))
        assert drive.ending == (TIME_LIMIT if b"time limit" in content[:size] else STOPPED)
    assert samples == sorted(samples, reverse=True)
    assert {*samples} == {*range(samples[-1], 12)}
    assert samples[-1] < 8


def test_a_full_disk_neither_stops_a_drive_nor_says_so_twice(env, tmp_path, monkeypatch, caplog):
    class Full(McapWriter):
        def add_message(self, *_: Any, **__: Any) -> None:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr("rover_rl.algos.deploy.bags.Writer", Full)
    with DriveBag(tmp_path / "drive.mcap", "maze", "scripted", 60.0) as bag:
        env.simulator.tap(bag.add)
        assert drive_to(env, ScriptedPolicy(), GOAL, bag=bag) == "goal"
    assert caplog.text.count("the drive is no longer recorded: [Errno 28] No space left on device") == 1


def test_a_folder_that_is_removed_is_reported_and_a_file_is_never_replaced(env, tmp_path, caplog):
    path = tmp_path / "bags" / "drive.mcap"
    with DriveBag(path, "maze", "scripted", 60.0) as bag:
        path.unlink()
        path.parent.rmdir()
        assert drive_to(env, ScriptedPolicy(), GOAL, bag=bag) == "goal"
    assert "the drive is no longer recorded: [Errno 2]" in caplog.text
    (tmp_path / "mine.mcap").write_text("mine")
    with pytest.raises(FileExistsError):
        DriveBag(tmp_path / "mine.mcap", "maze", "scripted", 60.0)
    assert (tmp_path / "mine.mcap").read_text() == "mine"


def test_a_disk_that_hangs_does_not_delay_a_drive(env, tmp_path, monkeypatch, caplog):
    goes_on = threading.Event()

    class Slow(McapWriter):
        def add_message(self, *args: Any, **options: Any) -> None:
            goes_on.wait(30.0)
            super().add_message(*args, **options)

    monkeypatch.setattr("rover_rl.algos.deploy.bags.Writer", Slow)
    monkeypatch.setattr("rover_rl.algos.deploy.bags.WAITING", 5)
    monkeypatch.setattr("rover_rl.algos.deploy.bags.CLOSE_TIMEOUT", 0.01)
    with DriveBag(tmp_path / "drive.mcap", "maze", "scripted", 60.0) as bag:
        assert drive_to(env, straight(0.3), (6.0, 0.0), seconds=1.0, bag=bag) == TIME_LIMIT
    goes_on.set()
    assert caplog.text.count("lacks messages: the disk is too slow") == 1


def test_times_are_the_rovers():
    """With a lidar at 10 Hz, each step lasts two control steps of the evaluation."""
    samples = [Sample(0.1, (0.1 * k, 0.0, 0.0), (0.0, 0.0, 0.0), torch.ones(1), collision=k == 5) for k in range(11)]
    trajectory = RecordedDrive((2.0, 0.0), samples, "stuck").trajectory()
    assert (trajectory.seconds, trajectory.length) == (pytest.approx(1.0), pytest.approx(1.0))
    assert trajectory.collision.nonzero().flatten().tolist() == [9]
    assert math.isnan(trajectory.reversals)


def stamped(x: float, y: float, frame: str = "map", yaw: float = 0.0) -> Any:
    heading = ros.Quaternion(z=math.sin(yaw / 2), w=math.cos(yaw / 2))
    return ros.PoseStamped(ros.Header(frame_id=frame), ros.Pose(ros.Point(x, y), heading))


def transform(x: float, y: float) -> Any:
    move = ros.Transform(ros.Vector3(x, y))
    return ros.TFMessage([ros.TransformStamped(ros.Header(ros.Time(int(x * 10)), "map"), "base_link", move)])


WAYS: dict[str, Callable[[float, float], Any]] = {
    "stamped": stamped,
    "covariance": lambda x, y: ros.PoseWithCovarianceStamped(
        ros.Header(frame_id="map"), ros.PoseWithCovariance(stamped(x, y).pose)
    ),
    "array": lambda x, y: ros.PoseArray(ros.Header(frame_id="map"), [stamped(x, y).pose]),
    "odometry": lambda x, y: ros.Odometry(ros.Header(frame_id="map"), pose=ros.PoseWithCovariance(stamped(x, y).pose)),
    "tf": transform,
}


def course(way: Callable[[float, float], Any] = stamped, topic: str = "/pose") -> list[tuple[float, str, Any]]:
    """Two seconds along x at 1 m/s past a wall at the left, to two goals: times, topics and messages."""
    angle = math.pi / 2
    scan = ros.LaserScan(angle_min=-math.pi, angle_max=math.pi - angle, angle_increment=angle)
    scan = replace(scan, ranges=np.array([9.0, 8.0, 7.0, 1.0], np.float32))
    messages = [(0.1 * k, topic, way(0.1 * k, 0.0)) for k in range(21)]
    messages += [(0.1 * k + 0.05, "/scan", scan) for k in range(20)]
    goals = [
        (0.21, stamped(-3.0, 0.0)),
        (0.22, stamped(-3.0, 0.0)),
        (0.51, stamped(1.5, 0.0)),
        (1.61, stamped(9.0, 0.0)),
    ]
    return sorted([*messages, *((at, "/goal_pose", goal) for at, goal in goals)], key=lambda each: each[0])


def write_mcap(path: Path, messages: list[tuple[float, str, Any]], encoding: str = "cdr", **options: Any) -> Path:
    with path.open("wb") as file:
        writer, channels = McapWriter(file, **options), dict[tuple[str, str], int]()
        writer.start(profile="ros2")
        for at, topic, message in messages:
            name = message.ros_type
            if (topic, name) not in channels:
                definition = ros.TYPES.generate_msgdef(name, ros_version=2)[0].encode()
                schema = writer.register_schema(name, "ros2msg", definition)
                channels[topic, name] = writer.register_channel(topic, encoding, schema)
            nanoseconds = round((100.0 + at) * NANO)
            writer.add_message(channels[topic, name], nanoseconds, ros.encode(message), nanoseconds)
        writer.finish()
    return path


def write_folder(path: Path, messages: list[tuple[float, str, Any]], plugin: StoragePlugin) -> Path:
    with BagWriter(path, version=9, storage_plugin=plugin) as writer:
        connections: dict[str, Any] = {}
        for at, topic, message in messages:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, message.ros_type, typestore=ros.TYPES)
            writer.write(connections[topic], round((100.0 + at) * NANO), ros.encode(message))
    return path


def check_course(path: Path, topics: BagTopics) -> None:
    """Drives are those of :func:`course`: one is replaced, one reaches its goal, and one lasts until the end."""
    found = read_drives(path, topics)
    assert (found.policy, found.world, found.robot, found.seconds) == (path.stem, None, "rover_zero", 1.0)
    first, second, third = found.drives
    assert [(one.goal, one.ending) for one in (first, second)] == [((-3.0, 0.0), "replaced"), ((1.5, 0.0), "goal")]
    assert (third.goal, third.ending) == ((9.0, 0.0), STOPPED)
    assert [round(drive.times[-1], 2) for drive in found.drives] == [0.29, 0.49, 0.39]
    assert [round(drive.samples[-1].position[0], 2) for drive in found.drives] == [0.5, 1.0, 2.0]
    assert second.samples[-1].reached


@pytest.mark.parametrize("way", [*WAYS])
def test_drives_of_others_are_read_by_their_goals_and_poses(way, tmp_path):
    topic = "/tf" if way == "tf" else "/pose"
    path = write_mcap(tmp_path / "lab.mcap", course(WAYS[way], topic))
    check_course(path, replace(FORWARD, pose=topic))


def test_bags_of_ros2_are_read_and_shown_with_their_scans(tmp_path, capsys):
    messages = course()
    for name, plugin in (("mcap", StoragePlugin.MCAP), ("sqlite", StoragePlugin.SQLITE3)):
        check_course(write_folder(tmp_path / name, messages, plugin), FORWARD)
    check_course(tmp_path / "sqlite" / "sqlite.db3", FORWARD)
    path = write_mcap(tmp_path / "lab.mcap", messages)
    drive = recording_of_drive(read_drives(path, FORWARD), 1)
    assert (drive.world.name, drive.ending) == ("none", "goal")
    beam = drive.moments[-1].scan[0].reshape(4, -1)[:, 0]
    assert beam.tolist() == [7.0, 1.0, 9.0, 8.0]
    options = ["--topics.pose", "/pose", "--topics.lidar-yaw", "0", "--out"]
    assert main(["evaluate", str(path), "--world", "maze", *options, str(tmp_path / "out")]) == 0
    (written,) = json.loads((tmp_path / "out" / "evaluation.json").read_text())
    assert (written["world"], written["endings"]) == ("maze", {"replaced": 1, "goal": 1, STOPPED: 1})
    assert main(["evaluate", str(path), *options, str(tmp_path / "flat")]) == 0
    (written,) = json.loads((tmp_path / "flat" / "evaluation.json").read_text())
    assert written["episodes"][1]["shortest"] == pytest.approx(0.5)


def test_a_bag_of_the_simulated_robot_needs_no_option(env, wire, tmp_path):
    """One that another program has recorded, of a drive to the goal of a topic."""
    messages: list[tuple[float, str, Any]] = [(0.0, "/goal_pose", stamped(*GOAL, frame="world"))]
    for topic in ("/scan", "/rover/pose_array"):
        wire.subscribe(topic, ros.LaserScan, lambda message, topic=topic: messages.append((wire.now, topic, message)))
    assert drive_to(env, ScriptedPolicy(), GOAL) == "goal"
    start = messages[1][0]
    path = write_mcap(tmp_path / "robot.mcap", [(max(0.0, at - start), *rest) for at, *rest in messages])
    (drive,) = read_drives(path).drives
    assert drive.ending == "goal"
    assert drive.trajectory().seconds == pytest.approx(len(drive.samples) * 0.05 - 0.05)
    sample = drive.samples[5]
    ahead = sample.ranges[0].item() * math.cos(sample.angles[2])
    assert sample.position[0] + ahead == pytest.approx(AHEAD, abs=0.3)


def moved(topic: str, to: str) -> list[tuple[float, str, Any]]:
    return [(at, to if name == topic else name, message) for at, name, message in course()]


def without(topic: str) -> list[tuple[float, str, Any]]:
    return [each for each in course() if each[1] != topic]


def by_turns(*poses: Any) -> list[tuple[float, str, Any]]:
    """The course with other poses, which take turns."""
    each = cycle(poses)
    return [(at, topic, next(each) if topic == "/pose" else message) for at, topic, message in course()]


FAR = by_turns(stamped(0.0, 0.0), stamped(7.0, 0.0))
FRAMES = by_turns(stamped(0.0, 0.0, "a/odom"), stamped(0.1, 0.0, "b/odom"))
BACK = [*course(), (-9.0, "/pose", stamped(0.0, 0.0))]
EARLY = [(0.0, "/pose", stamped(0.0, 0.0)), (1.0, "/goal_pose", stamped(1.5, 0.0))]


@pytest.mark.parametrize(
    ("messages", "told"),
    [
        (without("/goal_pose"), "has no goal on /goal_pose: name the topic with --topics.goal; it has /pose (geom"),
        (without("/pose"), "has no pose on /pose: name the topic with --topics.pose; it has /goal_pose (geometry"),
        ([], "has no goal on /goal_pose: name the topic with --topics.goal; it has no messages"),
        (moved("/scan", "/goal_pose"), "/goal_pose in BAG has geometry_msgs/PoseStamped or sensor_msgs/LaserScan, and"),
        (course(lambda x, y: ros.String("here")), "/pose in BAG has std_msgs/String, and --topics.pose takes geometry"),
        (EARLY, "there is no drive in BAG: no goal is followed by poses; it has"),
        (BACK, "the time in BAG goes back by 11.0 s on /pose, as of a simulation that has restarted"),
        (FAR, "the pose on /pose in BAG jumps 20 times by more than 1 m, as of several robots"),
        (FRAMES, "the poses on /pose in BAG are in the frames ['a/odom', 'b/odom'], as of several robots"),
        (course(partial(stamped, frame="odom")), "the goals in BAG are in the frame 'map', and the poses in ['odom']"),
    ],
)
def test_a_bag_that_does_not_tell_drives_is_one_sentence(messages, told, tmp_path, failed):
    path = write_mcap(tmp_path / "bag.mcap", messages)
    error = failed("evaluate", path, "--topics.pose", "/pose", "--out", tmp_path / "out")
    assert told.replace("BAG", str(path)) in error


def test_other_files_and_names_of_code_are_refused_in_one_sentence(env, tmp_path, failed, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("text.mcap").write_text("position: 1\n")
    Path("text.db3").write_text("position: 1\n")
    Path("old.jsonl").write_text('{"format": "rover_rl drive, version 1"}\n')
    write_mcap(Path("json.mcap"), course(), encoding="json")
    damaged = bytearray(write_mcap(Path("damaged.mcap"), course()).read_bytes())
    damaged[300:400] = bytes(100)
    Path("damaged.mcap").write_bytes(damaged)
    env.reset()
    with DriveBag(Path("code.mcap"), "os:abort", "scripted", 60.0) as bag:
        bag.begin(env.rover_state, env.scan, GOAL)
    for word, told in {
        "text.mcap": "text.mcap cannot be read: it is no MCAP file",
        "text.db3": "text.db3 cannot be read: ",
        "old.jsonl": "old.jsonl is a log of an older version, which is no longer read: drives are in .mcap files now",
        "damaged.mcap": "damaged.mcap cannot be read: ",
        "json.mcap": "/goal_pose in json.mcap has geometry_msgs/PoseStamped in json, and --topics.goal takes",
        "code.mcap": "code.mcap names code as its world: if you trust it, add --world os:abort",
        "none.mcap": "none.mcap: No such file or directory",
    }.items():
        assert told in failed("evaluate", word, "--out", "out")
