"""Transports that send and receive ROS 2 messages, and what is sent and logged through them."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable
from importlib import import_module
from typing import Any, Protocol, TypeAlias

from rover_rl.sims.ros2.messages import Header, Time, Twist, TwistStamped, Vector3
from rover_rl.sims.ros2.settings import Command, TransportName

Publisher: TypeAlias = Callable[[Any], None]
"""Function that publishes a message."""
TRANSPORTS: dict[TransportName, str] = {"dds": "DdsTransport", "rclpy": "RclpyTransport"}
"""Class of each transport, in the module of its name. Only the selected one is imported."""
HISTORY_DEPTH = 5
"""Number of unread messages of a best-effort topic that are kept. Reliable publishers keep one."""
ACTIVE_TIME = 1.0
"""Time since its last message during which a publisher counts as active, s."""
STOP_REPEATS = 3
"""Number of times that a stop command is sent, as a message may be lost."""
WARNING_INTERVAL = 5.0
"""Minimum time between two warnings with the same key, s."""


class Transport(Protocol):
    """A ROS 2 node's connection to other nodes.

    Messages are those of :mod:`rover_rl.sims.ros2.messages`, or objects with the same attributes.
    """

    def subscribe(self, topic: str, kind: Any, receive: Callable[[Any], object], *, reliable: bool = False) -> None:
        """Subscribes to a topic. A message that cannot be decoded is ignored with a warning.

        Messages that have arrived, on any topic, are passed on in the order in which they were sent.

        Args:
            topic: ROS 2 name of the topic.
            kind: class of the messages.
            receive: function that is called with each message, from the transport's thread. It returns False for an
                unusable message, which :meth:`publishers` does not count.
            reliable: whether to use reliable quality of service, which matches reliable publishers only. The default,
                best effort and volatile, matches every publisher.
        """
        ...

    def publisher(self, topic: str, kind: Any, *, reliable: bool = False) -> Publisher:
        """Creates a publisher of messages of class ``kind``.

        The quality of service is best effort with a history of five messages, as for sensor data; if ``reliable``, it
        is reliable with a history of one.
        """
        ...

    def overhear(self, topic: str, kind: Any, receive: Callable[[Any, str], object]) -> None:
        """Subscribes to what others send on a topic: neither this transport, nor one of the same name in this process.

        ``receive`` is called with each message and an identifier of its publisher for :meth:`name_of`.
        """
        ...

    def name_of(self, sender: str, topic: str) -> str:
        """Returns the name of the node of a publisher of ``topic``: see :meth:`overhear`."""
        ...

    def subscribers(self, topic: str) -> int:
        """Returns the number of subscribers of this transport's publisher on ``topic``, without its own."""
        ...

    def publishers(self, topic: str) -> int:
        """Returns the number of publishers that have sent usable messages on ``topic`` within the last second.

        The topic must be subscribed to. DDS itself detects only after many seconds that a publisher was killed.
        """
        ...

    def types(self, topic: str, receivers: bool = False) -> set[str]:
        """Returns the ROS 2 names of the types that known publishers of ``topic`` send, or known subscribers receive.

        Those of this transport are among them.
        """
        ...

    def close(self) -> None:
        """Releases all resources. Idempotent. No subscription's ``receive`` is called afterwards."""
        ...


def make_transport(name: TransportName, node: str) -> Transport:
    """Creates a transport for a node. Raises ``ImportError`` if a package that it requires is not installed."""
    return getattr(import_module(f"{__package__}.{name}"), TRANSPORTS[name])(node)


def other_types(transport: Transport, topic: str, kind: Any, receivers: bool = False) -> str:
    """Returns the types of a topic other than that of messages of class ``kind``; empty if it has no other.

    Publishers and subscribers of different types do not meet. For ``receivers``, see :meth:`Transport.types`.
    """
    return " and ".join(sorted(transport.types(topic, receivers) - {kind.ros_type})).replace("/msg/", "/")


class ActiveSenders:
    """Publishers of a topic that have sent within the last second, by any key."""

    def __init__(self) -> None:
        self._last_heard: dict[Any, float] = {}

    def heard(self, key: Any) -> None:
        """Takes note of a message."""
        self._last_heard[key] = time.monotonic()

    def active(self) -> list[Any]:
        """Returns the keys of the active publishers."""
        now = time.monotonic()
        return [key for key, last in list(self._last_heard.items()) if now - last < ACTIVE_TIME]

    def count(self) -> int:
        """Returns their number."""
        return len(self.active())


class CommandPublisher:
    """Publishes a rover's velocity commands; with ``kind="none"``, it sends nothing.

    ``last`` is the last command: forward speed (m/s) and yaw rate (rad/s). ``message`` is the class of the messages,
    and ``frame_id`` the frame of stamped ones.
    """

    def __init__(self, transport: Transport, topic: str, kind: Command, frame_id: str) -> None:
        self.last = (0.0, 0.0)
        self._frame_id = frame_id
        self._stamped = kind == "twist_stamped"
        self.message = TwistStamped if self._stamped else Twist
        self._publish = None if kind == "none" else transport.publisher(topic, self.message, reliable=True)

    def send(self, speed: float, yaw_rate: float) -> None:
        """Sends a forward speed (m/s) and a yaw rate (rad/s)."""
        self.last = (speed, yaw_rate)
        if self._publish is not None:
            twist = Twist(Vector3(x=speed), Vector3(z=yaw_rate))
            stamp = Time.from_seconds(time.time())
            self._publish(TwistStamped(Header(stamp, self._frame_id), twist) if self._stamped else twist)

    def stop(self) -> None:
        """Sends zero velocity, several times."""
        for _ in range(STOP_REPEATS):
            self.send(0.0, 0.0)


class ThrottledLogger:
    """Logs a warning with the same key at most once every five seconds."""

    def __init__(self, logger: logging.Logger) -> None:
        self._logger = logger
        self._logged: dict[str, float] = {}

    def warning(self, key: str, message: str, *values: object) -> None:
        """Logs a format string with its values, unless a warning with the same key was logged recently."""
        if time.monotonic() - self._logged.get(key, -math.inf) > WARNING_INTERVAL:
            self._logged[key] = time.monotonic()
            self._logger.warning(message, *values)
