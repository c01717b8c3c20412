"""ROS 2's own rclpy in other processes: with ``rover-rl robot``, with the DDS layer, and as ``transport="rclpy"``."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import ExitStack
from itertools import pairwise

import numpy as np
import pytest

from rover_rl.sims.ros2.dds import DdsTransport
from rover_rl.sims.ros2.messages import Header, LaserScan, Time, Twist, Vector3
from rover_rl.sims.ros2.transport import make_transport
from tests.sims.ros2.peer import Peer, RosNode
from tests.sims.ros2.processes import Command, start_robot, until

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
    """Environment variables of processes in a domain of these tests."""
    return {**os.environ, **domain, "ROS_DOMAIN_ID": str(int(domain["ROS_DOMAIN_ID"]) + 4)}


@pytest.fixture(scope="module")
def robot(environment) -> Iterator[Command]:
    robot = start_robot(environment, "--world", "maze")
    yield robot
    robot.kill()


@pytest.fixture(scope="module")
def original(peer, environment, robot) -> Iterator[RosNode]:
    """A node with the subscriptions of RoboTerrain's ``RoverEnv``."""
    node = RosNode(peer, environment, "turtlebot_controller")
    for topic, kind in TOPICS.items():
        best_effort = topic == "/rover/pose_array"
        node.subscribe(topic, kind, reliable=not best_effort, depth=1 if best_effort else 10)
    yield node
    node.kill()


def speeds(node: RosNode) -> list[float]:
    return [odometry["twist"]["twist"]["linear"]["x"] for _, odometry in node.received("/odometry/wheels")]


def drives(node: RosNode) -> bool:
    """Whether the robot follows the node's command."""
    node.publish("/cmd_vel", TWIST, {"linear": {"x": -0.5}})
    return any(speed < -0.3 for speed in speeds(node))


def hears_all(node: RosNode) -> bool:
    return all(node.count(topic) for topic in TOPICS)


def test_the_topics_of_a_robot_have_the_types_quality_and_rates_of_the_page(original):
    until(lambda: hears_all(original))
    for topic, kind in TOPICS.items():
        (publisher,) = original.publishers(topic)
        assert publisher["type"] == kind
        assert (publisher["reliability"], publisher["durability"]) == ("RELIABLE", "VOLATILE")
    for topic, kind in (("/cmd_vel", TWIST), ("/rover/set_pose", "geometry_msgs/msg/PoseStamped")):
        (subscription,) = original.subscriptions(topic)
        assert subscription["type"] == kind
        assert subscription["reliability"] == ("BEST_EFFORT" if topic == "/cmd_vel" else "RELIABLE")
    for topic in ("/scan", "/imu/data", "/odometry/wheels"):
        original.received(topic)
        until(lambda topic=topic: original.count(topic) > 20)
        stamps = [message["header"]["stamp"] for _, message in original.received(topic)]
        times = [stamp["sec"] + 1e-9 * stamp["nanosec"] for stamp in stamps]
        # A message that is late by more than the ten that are kept is lost.
        assert np.median([later - earlier for earlier, later in pairwise(times)]) == pytest.approx(0.05)


def test_a_robot_keeps_to_its_limits_and_says_what_it_refuses(peer, environment, robot, original):
    pose, stamped = "geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/TwistStamped"
    speeds(original)
    original.publish("/cmd_vel", TWIST, {"linear": {"x": 50.0}}, rate=20.0)
    until(lambda: original.count("/odometry/wheels") > 30)
    original.publish("/cmd_vel", TWIST, {})
    assert 0.8 < max(speeds(original)) < 1.1
    outside = {"header": {"frame_id": "world"}, "pose": {"position": {"x": 500.0}}}
    until(lambda: original.publish("/rover/set_pose", pose, outside) and "is not on the terrain" in robot.output)
    other = RosNode(peer, environment)
    try:
        other.publish("/cmd_vel", stamped, {})
        until(lambda: "/cmd_vel: ignored geometry_msgs/TwistStamped" in robot.output)
    finally:
        other.kill()


def test_messages_are_exchanged_unchanged_with_a_node(peer, domain):
    scan = LaserScan(Header(Time(3, 4), "lidar"), range_max=10.0, ranges=np.arange(640, dtype=np.float32))
    received: list[LaserScan] = []

    def start_peer() -> RosNode:
        node = RosNode(peer, {**os.environ, **domain})
        stack.callback(node.kill)
        node.subscribe("/cmd_vel", TWIST)
        fields = {"header": {"stamp": {"sec": 3, "nanosec": 4}, "frame_id": "lidar"}, "range_max": 10.0}
        node.publish("/scan", TOPICS["/scan"], fields | {"ranges": scan.ranges.tolist()}, rate=20.0)
        return node

    with ExitStack() as stack:
        transport = DdsTransport("rover_rl", domain)
        stack.callback(transport.close)
        transport.subscribe("/scan", LaserScan, received.append)
        publish = transport.publisher("/cmd_vel", Twist, reliable=True)
        node = start_peer()
        until(lambda: received and transport.subscribers("/cmd_vel"))
        assert transport.types("/scan") == {TOPICS["/scan"]}
        assert (received[0].header, received[0].range_max) == (scan.header, 10.0)
        np.testing.assert_array_equal(received[0].ranges, scan.ranges)
        # More than once: the other side may not know this one yet.
        until(lambda: publish(Twist(Vector3(x=0.5), Vector3(z=-0.25))) or node.count("/cmd_vel"))
        _, twist = node.received("/cmd_vel")[0]
        zero = {"x": 0.0, "y": 0.0, "z": 0.0}
        assert twist == {"linear": {**zero, "x": 0.5}, "angular": {**zero, "z": -0.25}}


def test_the_transport_rclpy_sends_receives_and_drives_a_robot(peer, environment, robot):
    with ExitStack() as stack:
        program = Peer(peer, environment, "transport")
        stack.callback(program.kill)
        node = RosNode(peer, environment)
        stack.callback(node.kill)
        topics = {"/own/twist": TWIST, "/own/scan": TOPICS["/scan"], "/own/poses": TOPICS["/rover/pose_array"]}
        for topic, kind in topics.items():
            node.subscribe(topic, kind, reliable=kind == TWIST)
        node.publish("/own/given", TOPICS["/scan"], {"ranges": [1.0, 2.0]}, rate=20.0)
        assert program.read() == "up"
        program.write("go")
        result = program.read()
        assert (result["subscribers"], result["types"]) == (1, [[TOPICS["/scan"]], []])
        assert (result["class"], result["ranges"]) == ("sensor_msgs", [1.0, 2.0])
        until(lambda: all(node.count(topic) for topic in topics))
        (_, twist), (_, scan), (_, poses) = (node.received(topic)[0] for topic in topics)
        assert twist["linear"]["x"] == 0.5
        assert (scan["header"]["stamp"]["nanosec"], scan["header"]["frame_id"]) == (2, "lidar")
        assert scan["ranges"] == list(range(640))
        assert [pose["position"]["y"] for pose in poses["poses"]] == [2.0]
        assert poses["poses"][0]["orientation"]["w"] == 1.0
        publishers = [node.publishers(topic)[0] for topic in topics]
        assert [each["type"] for each in publishers] == [*topics.values()]
        assert [each["reliability"] for each in publishers] == ["RELIABLE", "BEST_EFFORT", "BEST_EFFORT"]
        subscriptions = [node.subscriptions(topic)[0] for topic in ("/own/given", "/own/set_pose")]
        assert [each["reliability"] for each in subscriptions] == ["BEST_EFFORT", "RELIABLE"]
        assert {each["durability"] for each in (*publishers, *subscriptions)} == {"VOLATILE"}
        program.write("drive")
        result = program.read()
    assert not result["threads"]
    assert result["moved"] > 0.5
    assert result["speed"] > 0.9


def test_without_rclpy_the_error_says_what_to_do(monkeypatch):
    monkeypatch.setitem(sys.modules, "rclpy", None)
    monkeypatch.delitem(sys.modules, "rover_rl.sims.ros2.rclpy", raising=False)
    with pytest.raises(ImportError, match="pip install ros-jazzy-rclpy"):
        make_transport("rclpy", "rover")
