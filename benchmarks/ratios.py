"""Ratios of speeds, measured alternately in one run so that load affects both alike, and lines that tell of them."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any, TypeVar

Result = TypeVar("Result")


@dataclass(frozen=True)
class Ratio:
    """Ratio of two speeds: median steps per second of each, and median, smallest and largest ratio of the pairs."""

    rate: float
    other: float
    median: float
    least: float
    most: float


def paired(one: Callable[[], int], other: Callable[[], int], seconds: float, rounds: int) -> Ratio:
    """Measures two functions alternately, each of which takes some steps and returns their number.

    ``seconds`` is the approximate duration of each measurement, ``rounds`` the number of pairs.
    """
    one(), other()
    rates = [(rate(one, seconds), rate(other, seconds)) for _ in range(rounds)]
    ratios = [a / b for a, b in rates]
    return Ratio(*map(statistics.median, zip(*rates, strict=True)), statistics.median(ratios), min(ratios), max(ratios))


def rate(work: Callable[[], int], seconds: float) -> float:
    """Calls ``work`` for about ``seconds``. Returns the steps per second."""
    steps, begin = 0, time.perf_counter()
    while True:
        steps += work()
        passed = time.perf_counter() - begin
        if passed >= seconds:
            return steps / passed


def told(what: str, measure: Callable[[], Result]) -> Result:
    """Calls ``measure``. Prints a line before it, and one after it with the numbers of its result, a row or a ratio."""
    print(f"{what} ...", flush=True)
    begin = time.perf_counter()
    result: Any = measure()
    numbers = (asdict(result) if isinstance(result, Ratio) else result if isinstance(result, dict) else {}).items()
    found = [f"{name} {value:,.4g}" for name, value in numbers if isinstance(value, int | float)]
    print(f"{what}: {', '.join([*found, f'took {time.perf_counter() - begin:.0f} s'])}", flush=True)
    return result
