"""In-process transport."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any


class Wire:
    """In-process transport: a published message reaches its subscribers in the publishing thread.

    Attributes:
        receivers: callbacks of the subscriptions, by topic.
        sent: published messages, by topic.
        robots: number of publishers that :meth:`publishers` reports.
        tamper: function that modifies the messages of a topic, by topic.
        closed: whether the transport is closed.
    """

    def __init__(self, node: str = "") -> None:
        self.receivers: dict[str, list[Callable[[Any], None]]] = {}
        self.sent: dict[str, list[Any]] = {}
        self.robots = 1
        self.tamper: dict[str, Callable[[Any], Any]] = {}
        self.closed = False

    def subscribe(self, topic: str, kind: type, receive: Callable[[Any], None], *, reliable: bool = False) -> None:
        self.receivers.setdefault(topic, []).append(receive)

    def publisher(self, topic: str, kind: type, *, reliable: bool = False):
        def publish(message: Any) -> None:
            assert isinstance(message, kind)
            message = self.tamper.get(topic, lambda unchanged: unchanged)(message)
            self.sent.setdefault(topic, []).append(message)
            for receive in self.receivers.get(topic, []):
                receive(message)

        return publish

    def subscribers(self, topic: str) -> int:
        return len(self.receivers.get(topic, []))

    def publishers(self, topic: str) -> int:
        return self.robots

    def close(self) -> None:
        self.closed = True
