"""How messages come and go: the protocol that every transport keeps."""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from typing import Protocol, TypeAlias, TypeVar

from rover_rl.sims.ros2.messages import Message

M = TypeVar("M", bound=Message)

Publisher: TypeAlias = Callable[[M], None]
"""Sends a message."""

TRANSPORTS: dict[str, str] = {
    "dds": "rover_rl.sims.ros2.dds:DdsTransport",
    "rclpy": "rover_rl.sims.ros2.rclpy:RclpyTransport",
}
"""Transports by name: where their class is, so that only the one asked for is imported."""


class Transport(Protocol):
    """One node's connection to the other nodes.

    Messages are those of :mod:`rover_rl.sims.ros2.messages`, or others with the same attributes.
    """

    def subscribe(self, topic: str, kind: type[M], receive: Callable[[M], object], *, reliable: bool = False) -> None:
        """Calls ``receive`` with each message on ``topic`` that can be read, from a thread of the transport's own.

        The subscription takes what any publisher offers: best effort, volatile; ``reliable`` takes what is sent
        reliably alone, and misses nothing of it. What cannot be read is left out with a warning. ``receive`` returns
        False for a message that it cannot use, which does not count in :meth:`publishers`.
        """
        ...

    def publisher(self, topic: str, kind: type[M], *, reliable: bool = False) -> Publisher[M]:
        """A function that sends messages of ``kind`` on ``topic``.

        Args:
            topic: as ROS 2 writes it.
            kind: of the messages.
            reliable: send again what did not arrive, and keep the last message alone; else as sensors do.
        """
        ...

    def subscribers(self, topic: str) -> int:
        """How many listen to what is published here on ``topic``."""
        ...

    def publishers(self, topic: str) -> int:
        """How many publishers send usable messages on ``topic``, which is subscribed to here."""
        ...

    def close(self) -> None:
        """Releases all resources. Idempotent. ``receive`` is not called any more afterwards."""
        ...


def make_transport(name: str, node: str) -> Transport:
    """The transport of that name, for a node called ``node``.

    Raises:
        ValueError: for an unknown name.
        ImportError: if what it needs is not installed, and how to install it.
    """
    if name not in TRANSPORTS:
        raise ValueError(f"unknown transport {name!r}; use one of {sorted(TRANSPORTS)}")
    module, kind = TRANSPORTS[name].split(":")
    return getattr(import_module(module), kind)(node)
