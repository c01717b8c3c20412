"""Thread-safe store of the latest message of each kind."""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class ReceivedMessage:
    """A message's value, with its time of arrival.

    Attributes:
        value: value that was read from the message.
        time: arrival by :func:`time.monotonic`, s. The message's own stamp may be simulation time.
        number: sequence number among messages of its kind, starting at 1.
    """

    value: Any
    time: float
    number: int

    @property
    def age(self) -> float:
        """Time since arrival, s."""
        return time.monotonic() - self.time


class LatestMessages:
    """Stores the latest message of each kind. The transport's thread writes; other threads read and wait."""

    def __init__(self) -> None:
        self._latest: dict[str, ReceivedMessage] = {}
        self._changed = threading.Condition()

    def put(self, kind: str, value: Any) -> None:
        """Stores ``value`` as the latest of its kind."""
        with self._changed:
            previous = self._latest.get(kind)
            self._latest[kind] = ReceivedMessage(value, time.monotonic(), previous.number + 1 if previous else 1)
            self._changed.notify_all()

    def latest(self, kind: str) -> ReceivedMessage | None:
        """Returns the latest message of a kind, or ``None`` before the first one."""
        with self._changed:
            return self._latest.get(kind)

    def count(self, kind: str) -> int:
        """Returns the number of messages of a kind that have arrived."""
        message = self.latest(kind)
        return message.number if message else 0

    def wait(self, kind: str, after: int, timeout: float) -> ReceivedMessage | None:
        """Waits for a message of a kind.

        Args:
            kind: kind of the message.
            after: sequence number that the message must exceed.
            timeout: time to wait, s.

        Returns:
            The latest message, or ``None`` if none arrives in time.
        """
        with self._changed:
            if self._changed.wait_for(lambda: kind in self._latest and self._latest[kind].number > after, timeout):
                return self._latest[kind]
            return None
