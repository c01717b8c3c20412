"""Lines for those who wait for a benchmark: what is measured, and what was found."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import asdict
from typing import Any, TypeVar

from benchmarks.ratios import Ratio

Result = TypeVar("Result")


def told(what: str, measure: Callable[[], Result]) -> Result:
    """Calls ``measure``. Prints a line before it, and one after it with the numbers of its result, a row or a ratio."""
    print(f"{what} ...", flush=True)
    begin = time.perf_counter()
    result: Any = measure()
    numbers = (asdict(result) if isinstance(result, Ratio) else result if isinstance(result, dict) else {}).items()
    found = [f"{name} {value:,.4g}" for name, value in numbers if isinstance(value, int | float)]
    print(f"{what}: {', '.join([*found, f'took {time.perf_counter() - begin:.0f} s'])}", flush=True)
    return result
