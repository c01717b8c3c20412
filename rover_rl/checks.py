"""Checks of the numbers that users give. Imports no torch, so that settings can be checked without it."""

from __future__ import annotations

import operator
from typing import Any

MAX_SEED = 2**63 - 1
"""The largest seed; the smallest is 0."""
MAX_COUNT = 10**12
"""More than there is memory or time for."""
MAX_ROVERS = 10**6
"""More than a batch has had."""
MAX_NUMBER = 1e30
"""What 32-bit floats can be multiplied with and stay finite."""
MAX_SECONDS = 1e6
"""The longest drive that can be evaluated or filmed."""


def check_seed(seed: Any, count: int = 1) -> int:
    """The seed as an ``int``.

    Args:
        seed: a whole number of any integer type.
        count: seeds that are counted on from it, itself included, such as one a row: they must be in range, too.

    Raises:
        ValueError: naming what is allowed.
    """
    most = MAX_SEED - count + 1
    try:
        # True would count as 1, but nobody who writes it means that.
        whole = -1 if isinstance(seed, bool) else operator.index(seed)
    except TypeError:
        whole = -1
    if not 0 <= whole <= most:
        raise ValueError(f"seed must be a whole number from 0 to {most}, got {seed!r}")
    return whole


def check_at_least(least: float, most: float, **numbers: float) -> None:
    """Refuses numbers that are NaN, or not between ``least`` and ``most``.

    Raises:
        ValueError: naming the first of them.
    """
    for name, number in numbers.items():
        if not least <= number <= most:
            raise ValueError(f"{name} must be at least {least:g} and at most {most:g}, got {number}")


def check_positive(most: float, **numbers: float) -> None:
    """Refuses numbers that are NaN, not above 0, or above ``most``.

    Raises:
        ValueError: naming the first of them.
    """
    for name, number in numbers.items():
        if not 0 < number <= most:
            raise ValueError(f"{name} must be positive and at most {most:g}, got {number}")
