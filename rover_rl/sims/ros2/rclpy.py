"""ROS 2 transport through ROS 2's own client library, rclpy, and the middleware that it uses."""

from __future__ import annotations

import threading
import time
from collections import Counter, defaultdict, deque
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import fields, is_dataclass
from importlib import import_module
from itertools import count
from operator import itemgetter
from typing import Any

try:
    import rclpy
    from rcl_interfaces.msg import ParameterDescriptor
    from rclpy.context import Context
    from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
    from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
except ImportError as error:
    raise ModuleNotFoundError(
        "transport='rclpy' requires ROS 2's Python library: on Linux on x86-64, pip install ros-jazzy-rclpy and what "
        "docs/ros2.md lists; or source an installed ROS (/opt/ros/.../setup.bash), and use the Python that it was "
        "built for. transport='dds' requires neither",
        name="rclpy",
    ) from error

from rover_rl.sims.ros2.transport import HISTORY_DEPTH, NAMING_TIME, ActiveSenders, Publisher, Receive

MAX_LOST = 100  # messages of a publisher that may be lost one after the other
UNNAMED = "_NODE_NAME_UNKNOWN_"  # name of a node that has not been announced yet
REMEMBERED = 64  # messages of this process that are remembered, to tell them from those of others

_sent: defaultdict[tuple[str, str], deque[tuple[int, Any]]] = defaultdict(lambda: deque(maxlen=REMEMBERED))
"""Latest messages of this process with their sequence numbers, by node and topic."""


class RclpyTransport:
    """:class:`Transport` through an rclpy node, which spins in a thread; it passes on messages of ROS's own classes.

    The node has ``parameters``, which nobody can change while it runs.
    """

    def __init__(self, node: str, parameters: Mapping[str, Any]) -> None:
        self._context = Context()
        rclpy.init(context=self._context)
        self._name = f"/{node.strip('/')}"
        namespace, _, name = self._name.rpartition("/")
        self._node = rclpy.create_node(name, namespace=namespace, context=self._context)
        for key, value in parameters.items():
            if isinstance(value, str | int | float):
                self._node.declare_parameter(key, value, ParameterDescriptor(read_only=True))
        self._publishers: dict[str, Any] = {}
        self._subscriptions: Counter[str] = Counter()
        self._streams: defaultdict[str, _Streams] = defaultdict(_Streams)
        self._arrived: list[tuple[int, Callable[[Any, Any], object], Any, Any]] = []
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self._thread = threading.Thread(target=self._spin, name=f"{node} spins rclpy", daemon=True)
        self._closed = False
        self._thread.start()

    def subscribe(self, topic: str, kind: Any, receive: Receive, reliable: bool = False, latched: bool = False) -> None:
        streams = self._streams[topic]

        def take(message: Any, number: int | None) -> None:
            if receive(message) is not False:
                streams.heard(number)

        self._subscribe(topic, kind, take, _qos_profile(reliable, latched))

    def overhear(self, topic: str, kind: Any, receive: Callable[[Any, str], object]) -> None:
        # rclpy does not tell the publisher of a message, but its sequence number.
        sent = _sent[self._name, topic]

        def take(message: Any, number: int | None) -> None:
            if not any(number in (None, own) and message == content for own, content in [*sent]):
                receive(message, "")

        self._subscribe(topic, kind, take, _qos_profile(reliable=False))

    def _subscribe(self, topic: str, kind: Any, take: Callable[[Any, Any], object], qos: QoSProfile) -> None:
        def collect(message: Any, info: Any) -> None:
            self._arrived.append((info["source_timestamp"], take, message, info["publication_sequence_number"]))

        self._subscriptions[topic] += 1
        self._node.create_subscription(_ros_class(kind), topic, collect, qos)

    def publisher(self, topic: str, kind: Any, *, latched: bool = False) -> Publisher:
        publisher = self._node.create_publisher(_ros_class(kind), topic, _qos_profile(True, latched))
        self._publishers[topic] = publisher
        sent, numbers = _sent[self._name, topic], count(1)

        def publish(message: Any) -> None:
            converted = _to_ros(message)
            sent.append((next(numbers), converted))
            publisher.publish(converted)

        return publish

    def subscribers(self, topic: str) -> int:
        return max(0, self._publishers[topic].get_subscription_count() - self._subscriptions[topic])

    def publishers(self, topic: str) -> int:
        return len(self._streams[topic].active())

    def types(self, topic: str, receivers: bool = False) -> set[str]:
        node = self._node
        found = node.get_subscriptions_info_by_topic if receivers else node.get_publishers_info_by_topic
        return {info.topic_type for info in found(topic)}

    def name_of(self, sender: str, topic: str) -> str:
        """Returns the names of all other nodes that publish on a topic, of which one has sent the message."""
        own, deadline = {self._name, f"{self._name}_watchdog"}, time.monotonic() + NAMING_TIME
        others: list[str] = []
        while not others and time.monotonic() < deadline:
            time.sleep(0.01)
            infos = self._node.get_publishers_info_by_topic(topic)
            names = Counter(f"{info.node_namespace.rstrip('/')}/{info.node_name}" for info in infos)
            others = sorted(name for name, n in names.items() if n > (name in own) and not name.endswith(UNNAMED))
        return " or ".join(others) or "a publisher of no known node"

    def close(self) -> None:
        if self._closed:
            return
        self._closed = True
        self._executor.shutdown()
        self._thread.join()
        self._node.destroy_node()
        self._context.try_shutdown()

    def _spin(self) -> None:
        with suppress(ExternalShutdownException):
            while self._context.ok() and not self._closed:
                # Of two messages, the first may arrive after its subscription was looked at, and the second before its
                # own is. Another look finds it.
                self._executor.spin_once()
                found = 0
                while len(self._arrived) > found:
                    found = len(self._arrived)
                    self._executor.spin_once(timeout_sec=0)
                arrived, self._arrived = sorted(self._arrived, key=itemgetter(0)), []
                for _, take, message, number in arrived:
                    take(message, number)


class _Streams(ActiveSenders):
    """Publishers of a topic, which the sequence numbers of their messages tell apart."""

    def heard(self, key: int | None) -> None:
        """A message goes on with the publisher of the nearest lower number. Without numbers, there is one publisher."""
        before = [last for last in self.active() if key is not None and 0 < key - last <= MAX_LOST]
        if before:
            self._last_heard.pop(max(before))
        super().heard(key)


def _qos_profile(reliable: bool, latched: bool = False) -> QoSProfile:
    return QoSProfile(
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
        history=HistoryPolicy.KEEP_LAST,
        depth=1 if reliable else HISTORY_DEPTH,
    )


def _ros_class(kind: Any) -> Any:
    package, folder, name = kind.ros_type.split("/")
    return getattr(import_module(f"{package}.{folder}"), name)


def _to_ros(value: Any) -> Any:
    if is_dataclass(value):
        ros = _ros_class(value)()
        kinds = ros.get_fields_and_field_types()
        for field in fields(value):
            given = getattr(value, field.name)
            setattr(ros, field.name, bytes([given]) if kinds[field.name] == "octet" else _to_ros(given))
        return ros
    return [_to_ros(item) for item in value] if isinstance(value, list) else value
