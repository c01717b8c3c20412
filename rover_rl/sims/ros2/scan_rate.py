"""Measures how often scans come."""

from __future__ import annotations

from collections import deque

WINDOW = 20
"""Scans that a measurement spans."""
USABLE = (15.0, 30.0)
"""Rates that policies trained at 20 Hz are made for, Hz."""


class ScanRate:
    """Rate of the last scans by their stamps, or by their arrival where the stamps do not advance."""

    def __init__(self) -> None:
        self._times: deque[tuple[float, float]] = deque(maxlen=WINDOW + 1)

    def add(self, stamp: float, arrival: float) -> float | None:
        """Counts a scan.

        Args:
            stamp: by the sender's clock, s.
            arrival: by this machine's, s.

        Returns:
            Scans a second, Hz; ``None`` before there are enough of them, and while a clock jumps.
        """
        self._times.append((stamp, arrival))
        if len(self._times) <= WINDOW:
            return None
        by_stamp, by_arrival = (last - first for first, last in zip(self._times[0], self._times[-1], strict=True))
        span = by_stamp if by_stamp > 0 else by_arrival
        return WINDOW / span if span > 0 else None
