"""``transport="rclpy"`` with a fake of ROS's own library, which no package index provides."""

from __future__ import annotations

import importlib
import sys
import threading
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest

from rover_rl.sims.ros2 import messages
from rover_rl.sims.ros2.messages import (
    Contact,
    Contacts,
    Entity,
    Header,
    LaserScan,
    Pose,
    PoseArray,
    Time,
    Twist,
    Vector3,
)
from rover_rl.sims.ros2.transport import make_transport


class ShutDown(Exception):
    pass


class Executor:
    def __init__(self, context: Any) -> None:
        self._stop = threading.Event()

    def add_node(self, node: Any) -> None: ...

    def spin(self) -> None:
        self._stop.wait()
        raise ShutDown

    def shutdown(self) -> None:
        self._stop.set()


class Context:
    open = False

    def try_shutdown(self) -> None:
        self.open = False


class Node:
    made: list[Node]

    def __init__(self, name: str, context: Context) -> None:
        assert context.open
        self.name, self.context = name, context
        self.topics: dict[str, tuple[type, Any]] = {}
        self.sent: list[tuple[str, Any]] = []
        self.receivers: dict[str, Any] = {}
        Node.made.append(self)

    def create_subscription(self, kind: type, topic: str, receive: Any, qos: Any) -> None:
        self.topics[topic], self.receivers[topic] = (kind, qos), receive

    def create_publisher(self, kind: type, topic: str, qos: Any) -> Any:
        self.topics[topic] = (kind, qos)
        return SimpleNamespace(
            publish=lambda message: self.sent.append((topic, message)), get_subscription_count=lambda: 2
        )

    def get_publishers_info_by_topic(self, topic: str) -> list[Any]:
        return [SimpleNamespace(topic_type=self.topics[topic][0].ros_type)] if topic in self.topics else []

    def destroy_node(self) -> None: ...


@pytest.fixture
def ros(monkeypatch: pytest.MonkeyPatch) -> None:
    """Fakes a sourced ROS. Its message classes differ from the package's, and have the same fields."""
    Node.made = []

    def module(name: str, **content: Any) -> None:
        made = ModuleType(name)
        vars(made).update(content)
        monkeypatch.setitem(sys.modules, name, made)

    module(
        "rclpy",
        init=lambda context: setattr(context, "open", True),
        create_node=lambda name, context: Node(name, context),
    )
    module("rclpy.context", Context=Context)
    module("rclpy.executors", SingleThreadedExecutor=Executor, ExternalShutdownException=ShutDown)
    module(
        "rclpy.qos",
        DurabilityPolicy=SimpleNamespace(VOLATILE="volatile"),
        ReliabilityPolicy=SimpleNamespace(RELIABLE="reliable", BEST_EFFORT="best effort"),
        HistoryPolicy=SimpleNamespace(KEEP_LAST="keep last"),
        QoSProfile=SimpleNamespace,
    )
    kinds = [kind for kind in vars(messages).values() if isinstance(kind, type) and hasattr(kind, "ros_type")]
    for package in {kind.ros_type.split("/")[0] for kind in kinds}:
        own = {kind.__name__: type(kind.__name__, (kind,), {}) for kind in kinds if kind.ros_type.startswith(package)}
        module(package)
        module(f"{package}.msg", **own)
    monkeypatch.delitem(sys.modules, "rover_rl.sims.ros2.rclpy", raising=False)


def test_published_messages_are_instances_of_ros_classes(ros):
    transport = make_transport("rclpy", "rover")
    transport.publisher("/cmd_vel", Twist, reliable=True)(Twist(Vector3(x=0.5)))
    transport.publisher("/scan", LaserScan)(LaserScan(Header(Time(1, 2), "lidar"), ranges=np.ones(3, np.float32)))
    transport.publisher("/poses", PoseArray)(PoseArray(poses=[Pose()]))
    transport.publisher("/contacts", Contacts)(Contacts(contacts=[Contact(Entity(1, "wall"))]))
    (node,) = Node.made
    (_, twist), (_, scan), (_, poses), (_, contacts) = node.sent
    sensor_msgs, geometry_msgs = (importlib.import_module(f"{name}.msg") for name in ("sensor_msgs", "geometry_msgs"))
    assert type(twist) is geometry_msgs.Twist
    assert twist.linear.x == 0.5
    assert type(scan) is sensor_msgs.LaserScan
    assert (scan.header.stamp.sec, scan.header.frame_id, list(scan.ranges)) == (1, "lidar", [1, 1, 1])
    assert [type(pose) for pose in poses.poses] == [geometry_msgs.Pose]
    assert type(contacts.contacts[0].collision1) is importlib.import_module("ros_gz_interfaces.msg").Entity
    assert transport.subscribers("/cmd_vel") == 2
    assert transport.types("/scan") == {"sensor_msgs/msg/LaserScan"}
    assert transport.types("/points") == set()
    qos = {topic: qos for topic, (_, qos) in node.topics.items()}
    assert (qos["/cmd_vel"].reliability, qos["/cmd_vel"].depth) == ("reliable", 1)
    assert (qos["/scan"].reliability, qos["/scan"].durability) == ("best effort", "volatile")
    transport.close()


def test_subscriptions_are_best_effort_by_default(ros):
    received: list[Any] = []
    transport = make_transport("rclpy", "rover")
    transport.subscribe("/scan", LaserScan, received.append)
    (node,) = Node.made
    kind, qos = node.topics["/scan"]
    assert qos.reliability == "best effort"
    transport.subscribe("/rover/set_pose", PoseArray, received.append, reliable=True)
    assert node.topics["/rover/set_pose"][1].reliability == "reliable"
    node.receivers["/scan"](kind())
    assert len(received) == 1
    transport.close()
    transport.close()
    assert not node.context.open
    assert not [thread for thread in threading.enumerate() if "spins rclpy" in thread.name]


def test_without_ros_the_error_says_what_to_do(monkeypatch):
    monkeypatch.setitem(sys.modules, "rclpy", None)
    monkeypatch.delitem(sys.modules, "rover_rl.sims.ros2.rclpy", raising=False)
    with pytest.raises(ImportError, match="source ROS first"):
        make_transport("rclpy", "rover")
