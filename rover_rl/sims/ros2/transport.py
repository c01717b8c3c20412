"""Transports that send and receive ROS 2 messages."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Any, Protocol, TypeAlias

from rover_rl.sims.ros2.settings import TransportName

Publisher: TypeAlias = Callable[[Any], None]
Receive: TypeAlias = Callable[[Any], object]
Tap: TypeAlias = Callable[[str, Any, Any], None]
HISTORY_DEPTH = 5  # unread messages of a best-effort topic that are kept; publishers keep one
ACTIVE_TIME = 1.0  # time since its last message during which a publisher counts as active, s
NAMING_TIME = 0.3  # time to wait for the name of the node of a publisher, s
WARNING_INTERVAL = 5.0  # minimum time between two warnings with the same key, s


class Transport(Protocol):
    """A ROS 2 node's connection to other nodes.

    Messages are those of :mod:`rover_rl.sims.ros2.messages`, or objects with the same attributes; a ``kind`` is a class
    of them. Publishers are reliable with a history of one. Subscriptions are best effort with a history of five, which
    matches every publisher, or ``reliable``. One that is ``latched``, too, also gets the last message from before it
    came, if the publisher is.
    """

    def subscribe(self, topic: str, kind: Any, receive: Receive, reliable: bool = False, latched: bool = False) -> None:
        """Calls ``receive`` with each message, from the transport's thread, in the order of sending on any topic.

        A message that cannot be decoded is ignored with a warning. ``receive`` returns False for an unusable one, which
        :meth:`publishers` does not count.
        """

    def overhear(self, topic: str, kind: Any, receive: Callable[[Any, str], object]) -> None:
        """Subscribes to what others send on a topic: neither this transport, nor one of the same name in this process.

        ``receive`` is called with each message and an identifier of its publisher for :meth:`name_of`.
        """

    def publisher(self, topic: str, kind: Any, *, latched: bool = False) -> Publisher: ...

    def name_of(self, sender: str, topic: str) -> str:
        """Name of the node of a publisher that was overheard."""

    def subscribers(self, topic: str) -> int:
        """Number of subscribers of this transport's publisher on a topic, without its own."""

    def publishers(self, topic: str) -> int:
        """Number of publishers that have sent usable messages on a subscribed topic in the last second.

        DDS itself detects only after many seconds that a publisher was killed.
        """

    def types(self, topic: str, receivers: bool = False) -> set[str]:
        """ROS 2 names of the types that publishers of a topic send, or that its subscribers receive."""

    def close(self) -> None:
        """Releases all resources. Idempotent. No ``receive`` is called afterwards."""


def make_transport(name: TransportName, node: str, parameters: Mapping[str, Any] | None = None) -> Transport:
    """Creates a transport for a node. Raises ``ImportError`` if a package that it requires is not installed.

    With rclpy, the node tells ``parameters`` that are strings, numbers and bools (``ros2 param list``).
    """
    make = getattr(import_module(f"{__package__}.{name}"), f"{name.capitalize()}Transport")
    transport: Transport = make(node, parameters or {}) if name == "rclpy" else make(node)
    return transport


def other_types(transport: Transport, topic: str, kind: Any, receivers: bool = False) -> str:
    """Returns the types of a topic other than ``kind``, which therefore never meet it; empty if it has no other."""
    return " and ".join(map(short, sorted(transport.types(topic, receivers) - {kind.ros_type})))


def short(ros_type: str) -> str:
    return ros_type.replace("/msg/", "/")


class TappedTransport:
    """A :class:`Transport` that also passes all messages that it sends and receives to functions, such as a recorder.

    They are called from any thread with the topic, the class of the message and the message.
    """

    def __init__(self, transport: Transport) -> None:
        self._transport = transport
        self._taps: list[Tap] = []
        self._latched: dict[str, tuple[str, Any, Any]] = {}

    def tap(self, hear: Tap) -> None:
        """Calls ``hear`` with each message from now on, and with the last one of each latched topic."""
        self._taps.append(hear)
        for message in [*self._latched.values()]:
            hear(*message)

    def subscribe(self, topic: str, kind: Any, receive: Receive, reliable: bool = False, latched: bool = False) -> None:
        def both(message: Any) -> object:
            self._pass_on(latched, topic, kind, message)
            return receive(message)

        self._transport.subscribe(topic, kind, both, reliable=reliable, latched=latched)

    def publisher(self, topic: str, kind: Any, *, latched: bool = False) -> Publisher:
        publish = self._transport.publisher(topic, kind, latched=latched)

        def both(message: Any) -> None:
            publish(message)
            self._pass_on(latched, topic, kind, message)

        return both

    def _pass_on(self, latched: bool, topic: str, kind: Any, message: Any) -> None:
        if latched:
            self._latched[topic] = topic, kind, message
        for hear in self._taps:
            hear(topic, kind, message)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._transport, name)


class ActiveSenders:
    """Publishers of a topic that have sent within the last second, by any key."""

    def __init__(self) -> None:
        self._last_heard: dict[Any, float] = {}

    def heard(self, key: Any) -> None:
        self._last_heard[key] = time.monotonic()

    def active(self) -> list[Any]:
        now = time.monotonic()
        return [key for key, last in list(self._last_heard.items()) if now - last < ACTIVE_TIME]


class ThrottledLogger:
    """Logs a warning with the same key at most once every five seconds."""

    def __init__(self, logger: logging.Logger) -> None:
        self._logger = logger
        self._logged: dict[str, float] = {}

    def warning(self, key: str, message: str, *values: object) -> None:
        if time.monotonic() - self._logged.get(key, -math.inf) > WARNING_INTERVAL:
            self._logged[key] = time.monotonic()
            self._logger.warning(message, *values)
