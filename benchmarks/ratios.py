"""Two things measured in turn in one run, so that what disturbs one disturbs the other, too."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass


@dataclass(frozen=True)
class Ratio:
    """How much faster one thing is than another.

    Attributes:
        rate, other: median steps per second of each.
        median, least, most: of the ratios of the pairs.
    """

    rate: float
    other: float
    median: float
    least: float
    most: float


def paired(one: Callable[[], int], other: Callable[[], int], seconds: float, rounds: int) -> Ratio:
    """The speed of ``one`` beside that of ``other``; each does some steps when called, and returns how many."""
    one(), other()
    pairs = [(rate(one, seconds), rate(other, seconds)) for _ in range(rounds)]
    ratios = [a / b for a, b in pairs]
    return Ratio(
        rate=statistics.median(a for a, _ in pairs),
        other=statistics.median(b for _, b in pairs),
        median=statistics.median(ratios),
        least=min(ratios),
        most=max(ratios),
    )


def rate(work: Callable[[], int], seconds: float) -> float:
    """Steps per second of ``work`` over about ``seconds``."""
    steps, begin = 0, time.perf_counter()
    while True:
        steps += work()
        passed = time.perf_counter() - begin
        if passed >= seconds:
            return steps / passed
