"""Live rovers over the network: programs that drive, their watchdog, and ROS 2's own rclpy in other processes."""

from __future__ import annotations

import math
import os
import signal
import sys
import threading
import time
from collections import deque
from collections.abc import Iterator
from contextlib import closing

import numpy as np
import pytest
import torch

from rover_rl.cli import main
from rover_rl.robots import get_robot
from rover_rl.rotations import quaternion_to_euler
from rover_rl.sims.ros2 import Ros2Settings
from rover_rl.sims.ros2.commands import Watchdog
from rover_rl.sims.ros2.dds import DdsTransport
from rover_rl.sims.ros2.messages import LaserScan, TFMessage, Twist, Vector3
from rover_rl.sims.ros2.simulator import Ros2Simulator
from rover_rl.sims.ros2.transport import make_transport
from rover_rl.sims.settings import Connection
from rover_rl.worlds import get_world
from tests.sims.ros2.processes import NetworkRobot, Peer, drive, find_peer, until

pytestmark = [pytest.mark.ros2, pytest.mark.slow]

TOPICS = {
    "/scan": "sensor_msgs/msg/LaserScan",
    "/imu/data": "sensor_msgs/msg/Imu",
    "/odometry/wheels": "nav_msgs/msg/Odometry",
    "/rover/pose_array": "geometry_msgs/msg/PoseArray",
    "/clock": "rosgraph_msgs/msg/Clock",
}
TWIST = "geometry_msgs/msg/Twist"


@pytest.fixture(scope="module")
def environment(domain) -> dict[str, str]:
    return {**os.environ, **domain}


@pytest.fixture(scope="module")
def robot(environment) -> Iterator[NetworkRobot]:
    robot = NetworkRobot(environment)
    yield robot
    robot.close()


@pytest.fixture(scope="module")
def teleop(environment) -> Iterator[Peer]:
    """A node of rclpy."""
    with closing(Peer(find_peer(), environment, "node")) as node:
        yield node
        node.end()  # else the robot would wait for it


@pytest.fixture
def twists(in_domain) -> Iterator[list[Twist]]:
    """Commands on a topic without a robot."""
    received: list[Twist] = []
    transport = DdsTransport("rover")
    transport.subscribe("/alone/cmd_vel", Twist, received.append)
    yield received
    transport.close()


def watchdog(timeout: float) -> closing[Watchdog]:
    return closing(Watchdog("/alone/cmd_vel", Ros2Settings(), timeout))


def test_missing_heartbeats_stop_the_rover(twists):
    with watchdog(timeout=0.2) as dog:
        dog.wait_until_ready()
        time.sleep(0.4)
        assert not twists  # before the first heartbeat
        dog.alive()
        until(lambda: len(twists) > 10)
    assert all(twist == Twist() for twist in twists)


def test_a_watchdog_halts_the_rover_for_good_and_one_that_is_gone_or_hangs_raises_an_error(twists):
    with watchdog(timeout=100.0) as dog:
        dog.alive()
        dog.halt()
        until(lambda: len(twists) > 3)
        dog.alive()
        count = len(twists)
        until(lambda: len(twists) > count + 10)
        dog._process.send_signal(signal.SIGSTOP)
        with pytest.raises(ChildProcessError, match="the watchdog is gone"):
            deque(iter(dog.alive, 0), maxlen=0)  # until the pipe is full
        dog._process.kill()
        dog._process.wait()
        with pytest.raises(ChildProcessError, match="the watchdog is gone"):
            dog.alive()
    assert all(twist == Twist() for twist in twists)


def test_drive_drives_a_robot(robot, in_domain, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("rover_rl.cli.drive.SENSOR_TIMEOUT", 60.0)  # on a busy machine
    options = ["--goal", "2", "1", "--seconds", "1", "--timeout", "60", "--bag", str(tmp_path / "drive.mcap")]
    assert main(["drive", "scripted", "--world", "maze", *options]) == 1
    assert "goal 1, 2.00 1.00: " in capsys.readouterr().out
    assert max(speed for speed, _ in robot.twists) > 0.1
    assert robot.twists[-1] == (0.0, 0.0)


def test_a_program_that_hangs_or_dies_leaves_a_rover_that_stands(robot, environment):
    program = drive(environment)
    try:
        for number in (signal.SIGSTOP, signal.SIGKILL):
            until(lambda: robot.is_told(0.3))  # also after it has hung
            os.kill(program.pid, number)
            until(lambda: robot.is_told(0.0))
            if number == signal.SIGSTOP:
                os.kill(program.pid, signal.SIGCONT)
    finally:
        program.kill()
        program.join()
    until(lambda: robot.twists.clear() or time.sleep(1.0) or not robot.twists)  # the watchdog has ended


def test_a_node_of_rclpy_hears_all_topics_of_a_robot_and_drives_it(robot, teleop):
    for topic, kind in TOPICS.items():
        teleop.subscribe(topic, kind, topic != "/rover/pose_array")  # as RoboTerrain's RoverEnv does
    for topic, kind in TOPICS.items():
        until(lambda topic=topic: teleop.received(topic))
        assert teleop.publishers(topic) == [[kind, "RELIABLE", "VOLATILE"]]
    assert teleop.subscriptions("/cmd_vel")[0] == [TWIST, "BEST_EFFORT", "VOLATILE"]
    (subscription,) = teleop.subscriptions("/rover/set_pose")
    assert subscription == ["geometry_msgs/msg/PoseStamped", "RELIABLE", "VOLATILE"]
    teleop.publish("/cmd_vel", TWIST, {"linear": {"x": -0.5}}, 20.0)
    until(lambda: robot.rover.env.rover_state.linear_velocity < -0.4)
    teleop.publish("/cmd_vel", TWIST, {})


def test_late_subscribers_get_what_a_robot_has_told_once(robot, teleop, domain):
    teleop.subscribe("/robot_description", "std_msgs/msg/String", True, True)
    received: list[dict] = []
    until(lambda: received.extend(teleop.received("/robot_description")) or received)
    (told,) = received
    assert told["data"].startswith('<robot name="rover_zero">')
    frames: list[TFMessage] = []
    moving: list[TFMessage] = []
    with closing(DdsTransport("late", domain)) as transport:
        transport.subscribe("/tf_static", TFMessage, frames.append, reliable=True, latched=True)
        transport.subscribe("/tf", TFMessage, moving.append)
        until(lambda: frames and len(moving) > 3)
    assert {each.child_frame_id for each in frames[0].transforms} == {"lidar_link", "imu_link", "world"}
    assert [each.child_frame_id for each in moving[-1].transforms] == ["base_link", "odom"]


def test_a_node_of_rclpy_sends_goals_and_cancels_them_and_hears_of_the_plan(
    robot, teleop, in_domain, tmp_path, monkeypatch
):
    monkeypatch.setattr("rover_rl.cli.drive.SENSOR_TIMEOUT", 60.0)  # on a busy machine
    pose, told, stopped = "geometry_msgs/msg/PoseStamped", [], []
    ended, outputs = threading.Event(), dict[str, list[dict]]()
    kinds = {"/plan": "nav_msgs/msg/Path", "/seen_map": "nav_msgs/msg/OccupancyGrid"}
    for topic, kind in kinds.items():
        teleop.subscribe(topic, kind, True, True)
    teleop.subscribe("/diagnostics", "diagnostic_msgs/msg/DiagnosticArray")
    teleop.subscribe("/goal_pose/status", "std_msgs/msg/String", True, True)

    def is_told(status: str) -> bool:
        told.extend(one["data"] for one in teleop.received("/goal_pose/status"))
        return any(one.startswith(status) for one in told)

    def send(topic: str, kind: str, fields: dict, status: str) -> None:
        """Sends a message, again each second, as the first ones of a new publisher may be lost."""
        for _ in range(120):
            teleop.publish(topic, kind, fields)
            end = time.monotonic() + 1.0
            while time.monotonic() < end:
                if is_told(status):
                    return
                time.sleep(0.02)

    def send_goals() -> None:
        try:
            until(lambda: is_told("waiting"))
            for x, frame, status in ((9.0, "map", "driving to 9.00 0.00"), (-9.0, "odom", "driving to -")):
                send("/goal_pose", pose, {"header": {"frame_id": frame}, "pose": {"position": {"x": x}}}, status)
            until(lambda: robot.twists[-1] != (0.0, 0.0))
            for topic in (*kinds, "/diagnostics"):
                until(
                    lambda topic=topic: outputs.setdefault(topic, []).extend(teleop.received(topic)) or outputs[topic]
                )
            send("/goal_pose/cancel", "std_msgs/msg/Empty", {}, "canceled")
            until(lambda: robot.twists[-1] == (0.0, 0.0))
            stopped.append(True)
        finally:
            if not ended.is_set():
                os.kill(os.getpid(), signal.SIGINT)

    sender = threading.Thread(target=send_goals)
    sender.start()
    options = ["--goal-topic", "/goal_pose", "--pose", "tf", "--seconds", "600", "--timeout", "60"]
    code = main(["drive", "gridplanner", "--world", "maze", *options, "--bag", str(tmp_path / "drive.mcap")])
    ended.set()
    sender.join()
    assert code == 130
    assert stopped
    assert {outputs[topic][0]["header"]["frame_id"] for topic in kinds} == {"map"}
    assert outputs["/plan"][0]["poses"]
    assert outputs["/seen_map"][0]["info"]["width"] == 128
    assert "rover_rl: /scan" in {status["name"] for status in outputs["/diagnostics"][0]["status"]}


def test_messages_are_exchanged_unchanged_with_a_node_of_rclpy(teleop, domain):
    received: list[LaserScan] = []
    ranges = np.arange(640, dtype=np.float32)
    with closing(DdsTransport("rover_rl", domain)) as transport:
        transport.subscribe("/own/scan", LaserScan, received.append)
        publish = transport.publisher("/own/twist", Twist)
        teleop.subscribe("/own/twist", TWIST)
        header = {"stamp": {"sec": 3, "nanosec": 4}, "frame_id": "lidar"}
        fields = {"header": header, "range_max": 10.0, "ranges": ranges.tolist()}
        teleop.publish("/own/scan", TOPICS["/scan"], fields, 20.0)
        until(lambda: received and transport.subscribers("/own/twist"))
        teleop.publish("/own/scan", TOPICS["/scan"], fields)
        assert transport.types("/own/scan") == {TOPICS["/scan"]}
        stamp = received[0].header.stamp
        assert (stamp.sec, stamp.nanosec, received[0].header.frame_id, received[0].range_max) == (3, 4, "lidar", 10.0)
        np.testing.assert_array_equal(received[0].ranges, ranges)
        # More than once: the other side may not know this one yet.
        heard: list[dict] = []
        until(
            lambda: (
                publish(Twist(Vector3(x=0.5), Vector3(z=-0.25))) or heard.extend(teleop.received("/own/twist")) or heard
            )
        )
        zero = {"x": 0.0, "y": 0.0, "z": 0.0}
        assert heard[0] == {"linear": {**zero, "x": 0.5}, "angular": {**zero, "z": -0.25}}


def test_the_transport_rclpy_drives_a_robot_until_another_node_does_which_is_named(robot, teleop, environment):
    teleop.publish("/cmd_vel", TWIST, {})  # a publisher that is silent does not matter
    robot.twists.clear()
    with closing(Peer(find_peer(), environment, "driver")) as program:
        until(lambda: any(speed == pytest.approx(0.3) for speed, _ in robot.twists))
        teleop.publish("/cmd_vel", TWIST, {"linear": {"x": -0.1}}, 10.0)
        told = program.read()
    until(lambda: robot.is_told(-0.1))
    teleop.publish("/cmd_vel", TWIST, {})
    assert told["error"].startswith("/teleop also sends commands on /cmd_vel, so that the rover is stopped: end it")
    assert not told["threads"]
    assert told["types"] == [[TWIST], []]
    assert told["parameters"] == ["tf", 0.5, False]  # the last: another node cannot change them


def test_imu_and_odometry_are_those_of_the_scan(domain, environment, monkeypatch):
    """The rover takes a step when it receives a command, so that nothing depends on how busy the machine is."""
    for name in ("sensors.COMPANY_TIME", "simulator.BRAKE_TIMEOUT"):
        monkeypatch.setattr(f"rover_rl.sims.ros2.{name}", 60.0)
    other = {**domain, "ROS_DOMAIN_ID": str(int(domain["ROS_DOMAIN_ID"]) + 1)}
    for name, value in other.items():
        monkeypatch.setenv(name, value)
    settings = Ros2Settings(reset="none", step_timeout=60.0)
    with closing(Peer(find_peer(), {**environment, **other}, "numbered")):
        simulator = Ros2Simulator([get_world("maze")], get_robot("rover_zero"), settings, Connection(timeout=60.0))
        with closing(simulator):
            steps = []
            for _ in range(200):
                state = simulator.step(torch.zeros(1, 2))
                yaw = quaternion_to_euler(state.orientation)[0, 2].item()
                steps.append(
                    (20 * state.stamp.item(), 100 * yaw % (200 * math.pi), 1000 * state.linear_velocity.item())
                )
    stamps, headings, speeds = np.array(steps)[20:].T  # the first messages of a new connection may be lost
    np.testing.assert_allclose(headings, stamps, atol=0.1)
    np.testing.assert_allclose(speeds, stamps, atol=0.1)


def test_without_rclpy_the_error_says_what_to_do(monkeypatch):
    monkeypatch.setitem(sys.modules, "rclpy", None)
    monkeypatch.delitem(sys.modules, "rover_rl.sims.ros2.rclpy", raising=False)
    with pytest.raises(ImportError, match="pip install ros-jazzy-rclpy"):
        make_transport("rclpy", "rover")
