"""Protocol of the transports that send and receive ROS 2 messages."""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from typing import Protocol, TypeAlias, TypeVar

from rover_rl.sims.ros2.messages import Message

M = TypeVar("M", bound=Message)

Publisher: TypeAlias = Callable[[M], None]
"""Function that publishes a message."""

TRANSPORTS: dict[str, str] = {
    "dds": "rover_rl.sims.ros2.dds:DdsTransport",
    "rclpy": "rover_rl.sims.ros2.rclpy:RclpyTransport",
}
"""Import path of each transport's class, by name. Only the selected transport is imported."""


class Transport(Protocol):
    """A ROS 2 node's connection to other nodes.

    Messages are those of :mod:`rover_rl.sims.ros2.messages`, or objects with the same attributes.
    """

    def subscribe(self, topic: str, kind: type[M], receive: Callable[[M], object], *, reliable: bool = False) -> None:
        """Subscribes to a topic.

        A message that cannot be decoded is ignored with a warning.

        Args:
            topic: ROS 2 name of the topic.
            kind: type of the messages.
            receive: function that is called with each message, from the transport's thread. It returns False for an
                unusable message, which :meth:`publishers` does not count.
            reliable: whether to use reliable quality of service, which matches reliable publishers only. The default,
                best effort and volatile, matches every publisher.
        """
        ...

    def publisher(self, topic: str, kind: type[M], *, reliable: bool = False) -> Publisher[M]:
        """Creates a publisher.

        Args:
            topic: ROS 2 name of the topic.
            kind: type of the messages.
            reliable: whether to use reliable quality of service with a history of one message. The default is best
                effort with a history of five messages, as for sensor data.

        Returns:
            A function that publishes a message.
        """
        ...

    def subscribers(self, topic: str) -> int:
        """Returns the number of subscribers of this transport's publisher on ``topic``."""
        ...

    def publishers(self, topic: str) -> int:
        """Returns the number of publishers that send usable messages on ``topic``, which must be subscribed to."""
        ...

    def close(self) -> None:
        """Releases all resources. Idempotent. No subscription's ``receive`` is called afterwards."""
        ...


def make_transport(name: str, node: str) -> Transport:
    """Creates a transport by name.

    Args:
        name: name of the transport: one of :data:`TRANSPORTS`.
        node: name of the node.

    Raises:
        ValueError: if the name is unknown.
        ImportError: if a package that the transport requires is not installed.
    """
    if name not in TRANSPORTS:
        raise ValueError(f"unknown transport {name!r}; use one of {sorted(TRANSPORTS)}")
    module, kind = TRANSPORTS[name].split(":")
    return getattr(import_module(module), kind)(node)
