"""The newest of each kind of message, and when it came."""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Arrival:
    """What a message said, and when.

    Attributes:
        value: that was read from it.
        time: of its arrival by :func:`time.monotonic`, s. The message's own stamp may be a simulation's.
        number: of its kind, counted from 1.
    """

    value: Any
    time: float
    number: int

    @property
    def age(self) -> float:
        """Seconds since it came."""
        return time.monotonic() - self.time


class LatestMessages:
    """Filled by the transport's thread, read and waited on by others."""

    def __init__(self) -> None:
        self._newest: dict[str, Arrival] = {}
        self._changed = threading.Condition()

    def put(self, kind: str, value: Any) -> None:
        """Keeps ``value`` as the newest of its kind."""
        with self._changed:
            known = self._newest.get(kind)
            self._newest[kind] = Arrival(value, time.monotonic(), known.number + 1 if known else 1)
            self._changed.notify_all()

    def newest(self, kind: str) -> Arrival | None:
        """The newest of its kind; ``None`` before the first."""
        with self._changed:
            return self._newest.get(kind)

    def count(self, kind: str) -> int:
        """How many have come."""
        arrival = self.newest(kind)
        return arrival.number if arrival else 0

    def wait(self, kind: str, after: int, timeout: float) -> Arrival | None:
        """The first to come after number ``after``, or a later one; ``None`` if none comes in time (s)."""
        with self._changed:
            if self._changed.wait_for(lambda: kind in self._newest and self._newest[kind].number > after, timeout):
                return self._newest[kind]
            return None
