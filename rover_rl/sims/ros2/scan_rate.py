"""Measurement of the lidar's scan rate."""

from __future__ import annotations

from collections import deque

WINDOW = 20
"""Number of scan periods in a measurement."""
SUPPORTED_RATES = (15.0, 30.0)
"""Scan rates that policies trained at 20 Hz support, Hz."""


class ScanRate:
    """Measures the rate of the last scans by their stamps, or by their arrival if the stamps do not advance."""

    def __init__(self) -> None:
        self._times: deque[tuple[float, float]] = deque(maxlen=WINDOW + 1)

    def add(self, stamp: float, arrival: float) -> float | None:
        """Adds a scan and returns the scan rate.

        Args:
            stamp: time of the scan by the sender's clock, s.
            arrival: time of its arrival by the local clock, s.

        Returns:
            The scan rate, Hz; ``None`` until the window is full, and while a clock jumps.
        """
        self._times.append((stamp, arrival))
        if len(self._times) <= WINDOW:
            return None
        by_stamp, by_arrival = (last - first for first, last in zip(self._times[0], self._times[-1], strict=True))
        span = by_stamp if by_stamp > 0 else by_arrival
        return WINDOW / span if span > 0 else None
