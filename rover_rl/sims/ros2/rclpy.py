"""ROS 2 transport through ROS 2's own client library, rclpy, and the middleware that it uses."""

from __future__ import annotations

import threading
from collections.abc import Callable
from contextlib import suppress
from dataclasses import fields, is_dataclass
from importlib import import_module
from typing import Any

try:
    import rclpy
    from rclpy.context import Context
    from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
    from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
except ImportError as error:
    raise ImportError(
        "transport='rclpy' requires ROS 2's Python library: on Linux on x86-64, pip install ros-jazzy-rclpy "
        "ros-jazzy-rmw-fastrtps-cpp ros-jazzy-nav-msgs ros-jazzy-sensor-msgs ros-jazzy-rosgraph-msgs; or source an "
        "installed ROS (/opt/ros/.../setup.bash), and use the Python that it was built for. transport='dds' requires "
        "neither"
    ) from error

from rover_rl.sims.ros2.transport import HISTORY_DEPTH, Publisher


class RclpyTransport:
    """:class:`Transport` through an rclpy node, which spins in a thread of its own.

    Received messages are instances of ROS's own classes.
    """

    def __init__(self, node: str) -> None:
        self._context = Context()
        rclpy.init(context=self._context)
        self._node = rclpy.create_node(node, context=self._context)
        self._publishers: dict[str, Any] = {}
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self._thread = threading.Thread(target=self._spin, name=f"{node} spins rclpy", daemon=True)
        self._thread.start()
        self._closed = False

    def subscribe(self, topic: str, kind: Any, receive: Callable[[Any], object], *, reliable: bool = False) -> None:
        """See :meth:`Transport.subscribe`."""
        self._node.create_subscription(_ros_class(kind), topic, receive, _qos_profile(reliable))

    def publisher(self, topic: str, kind: Any, *, reliable: bool = False) -> Publisher:
        """See :meth:`Transport.publisher`."""
        publisher = self._node.create_publisher(_ros_class(kind), topic, _qos_profile(reliable))
        self._publishers[topic] = publisher
        return lambda message: publisher.publish(_to_ros(message))

    def subscribers(self, topic: str) -> int:
        """See :meth:`Transport.subscribers`."""
        return self._publishers[topic].get_subscription_count()

    def publishers(self, topic: str) -> int:
        """Returns the number of publishers of ``topic``, whether they send or not."""
        return self._node.count_publishers(topic)

    def types(self, topic: str) -> set[str]:
        """See :meth:`Transport.types`."""
        return {info.topic_type for info in self._node.get_publishers_info_by_topic(topic)}

    def close(self) -> None:
        """See :meth:`Transport.close`."""
        if self._closed:
            return
        self._closed = True
        self._executor.shutdown()
        self._thread.join()
        self._node.destroy_node()
        self._context.try_shutdown()

    def _spin(self) -> None:
        with suppress(ExternalShutdownException):
            self._executor.spin()


def _qos_profile(reliable: bool) -> QoSProfile:
    return QoSProfile(
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.VOLATILE,
        history=HistoryPolicy.KEEP_LAST,
        depth=1 if reliable else HISTORY_DEPTH,
    )


def _ros_class(kind: Any) -> Any:
    """Returns ROS's class for a message class or message."""
    package, folder, name = kind.ros_type.split("/")
    return getattr(import_module(f"{package}.{folder}"), name)


def _to_ros(value: Any) -> Any:
    """Returns a message, in fields and lists too, as an instance of ROS's class; other values unchanged."""
    if is_dataclass(value):
        ros = _ros_class(value)()
        for field in fields(value):
            setattr(ros, field.name, _to_ros(getattr(value, field.name)))
        return ros
    return [_to_ros(item) for item in value] if isinstance(value, list) else value
