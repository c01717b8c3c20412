"""A node of ROS 2's own rclpy, ``teleop``, that a test directs: see :class:`tests.sims.ros2.processes.Peer`.

Each line of the input is a call, ``[method, arguments]`` in JSON, and each line of the output is its result. Messages
are dictionaries.
"""

from __future__ import annotations

import json
import sys
import threading
from contextlib import suppress
from importlib import import_module
from typing import Any

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy


class Node:
    def __init__(self) -> None:
        rclpy.init()
        self._node = rclpy.create_node("teleop")
        self._received: dict[str, list[Any]] = {}
        self._publishers: dict[str, Any] = {}
        self._timers: dict[str, Any] = {}
        threading.Thread(target=self._spin, daemon=True).start()

    def subscribe(self, topic: str, kind: str, reliable: bool = True, latched: bool = False) -> None:
        received = self._received.setdefault(topic, [])
        reliability = ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT
        durability = DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE
        profile = QoSProfile(depth=10, reliability=reliability, durability=durability)
        self._node.create_subscription(_class(kind), topic, received.append, profile)

    def received(self, topic: str) -> list[Any]:
        """Messages on a topic since the last call."""
        messages, self._received[topic][:] = [*self._received[topic]], []
        return [_fields(message) for message in messages]

    def publish(self, topic: str, kind: str, fields: Any, rate: float = 0.0) -> None:
        """Publishes a message once, or from now on at a rate, Hz."""
        if topic not in self._publishers:
            self._publishers[topic] = self._node.create_publisher(_class(kind), topic, 10)
        publisher, message = self._publishers[topic], _set(_class(kind)(), fields)
        if topic in self._timers:
            self._node.destroy_timer(self._timers.pop(topic))
        publisher.publish(message)
        if rate:
            self._timers[topic] = self._node.create_timer(1 / rate, lambda: publisher.publish(message))

    def publishers(self, topic: str) -> list[list[str]]:
        """Type, reliability and durability of each publisher on a topic."""
        return [_endpoint(each) for each in self._node.get_publishers_info_by_topic(topic)]

    def subscriptions(self, topic: str) -> list[list[str]]:
        return [_endpoint(each) for each in self._node.get_subscriptions_info_by_topic(topic)]

    def end(self) -> None:
        rclpy.shutdown()
        self._node.destroy_node()

    def _spin(self) -> None:
        with suppress(ExternalShutdownException):
            rclpy.spin(self._node)


def _class(kind: str) -> Any:
    package, folder, name = kind.split("/")
    return getattr(import_module(f"{package}.{folder}"), name)


def _endpoint(info: Any) -> list[str]:
    return [info.topic_type, info.qos_profile.reliability.name, info.qos_profile.durability.name]


def _fields(value: Any) -> Any:
    if hasattr(value, "get_fields_and_field_types"):
        return {name: _fields(getattr(value, name)) for name in value.get_fields_and_field_types()}
    if isinstance(value, bytes):
        return [*value]
    if hasattr(value, "tolist"):
        return value.tolist()
    return [_fields(item) for item in value] if isinstance(value, (list, tuple)) else value


def _set(message: Any, fields: dict[str, Any]) -> Any:
    for name, value in fields.items():
        setattr(message, name, _set(getattr(message, name), value) if isinstance(value, dict) else value)
    return message


node = Node()
print(json.dumps("up"), flush=True)
for line in sys.stdin:
    method, *arguments = json.loads(line)
    print(json.dumps(getattr(node, method)(*arguments)), flush=True)
