"""A node of ROS 2's own rclpy that a test directs: see :class:`tests.sims.ros2.peer.RosNode`.

Each line of the input is a call, ``[method, arguments]`` in JSON, and each line of the output is its result.

    python node.py NAME
"""

from __future__ import annotations

import json
import sys
import threading
import time
from contextlib import suppress
from importlib import import_module
from typing import Any

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.qos import QoSProfile, ReliabilityPolicy


class Node:
    def __init__(self, name: str) -> None:
        rclpy.init()
        self._node = rclpy.create_node(name)
        self._received: dict[str, list[Any]] = {}
        self._publishers: dict[tuple[str, str], Any] = {}
        self._timers: dict[tuple[str, str], Any] = {}
        threading.Thread(target=self._spin, daemon=True).start()

    def subscribe(self, topic: str, kind: str, reliable: bool = True, depth: int = 10) -> None:
        received = self._received.setdefault(topic, [])
        self._node.create_subscription(
            _class(kind), topic, lambda message: received.append((time.monotonic(), message)), _qos(reliable, depth)
        )

    def received(self, topic: str) -> list[tuple[float, Any]]:
        messages, self._received[topic][:] = [*self._received[topic]], []
        return [(moment, _fields(message)) for moment, message in messages]

    def count(self, topic: str) -> int:
        return len(self._received[topic])

    def publish(self, topic: str, kind: str, fields: Any, rate: float = 0.0) -> int:
        key = (topic, kind)
        if key not in self._publishers:
            self._publishers[key] = self._node.create_publisher(_class(kind), topic, _qos(True, 10))
        publisher, message = self._publishers[key], _set(_class(kind)(), fields)
        if key in self._timers:
            self._node.destroy_timer(self._timers.pop(key))
        publisher.publish(message)
        if rate:
            self._timers[key] = self._node.create_timer(1 / rate, lambda: publisher.publish(message))
        return publisher.get_subscription_count()

    def publishers(self, topic: str) -> list[dict[str, Any]]:
        return [_endpoint(each) for each in self._node.get_publishers_info_by_topic(topic)]

    def subscriptions(self, topic: str) -> list[dict[str, Any]]:
        return [_endpoint(each) for each in self._node.get_subscriptions_info_by_topic(topic)]

    def nodes(self) -> list[str]:
        return self._node.get_node_names()

    def _spin(self) -> None:
        with suppress(ExternalShutdownException):
            rclpy.spin(self._node)


def _qos(reliable: bool, depth: int) -> QoSProfile:
    return QoSProfile(
        depth=depth, reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT
    )


def _class(kind: str) -> Any:
    package, folder, name = kind.split("/")
    return getattr(import_module(f"{package}.{folder}"), name)


def _endpoint(info: Any) -> dict[str, Any]:
    qos = info.qos_profile
    names = {"reliability": qos.reliability.name, "durability": qos.durability.name}
    return {"node": info.node_name, "type": info.topic_type, **names}


def _fields(value: Any) -> Any:
    if hasattr(value, "get_fields_and_field_types"):
        return {name: _fields(getattr(value, name)) for name in value.get_fields_and_field_types()}
    if hasattr(value, "tolist"):
        return value.tolist()
    return [_fields(item) for item in value] if isinstance(value, (list, tuple)) else value


def _set(message: Any, fields: dict[str, Any]) -> Any:
    for name, value in fields.items():
        setattr(message, name, _set(getattr(message, name), value) if isinstance(value, dict) else value)
    return message


def main() -> None:
    node = Node(sys.argv[1])
    print(json.dumps("up"), flush=True)
    for line in sys.stdin:
        method, *arguments = json.loads(line)
        print(json.dumps(getattr(node, method)(*arguments)), flush=True)


if __name__ == "__main__":
    main()
