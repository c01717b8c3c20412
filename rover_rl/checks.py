"""Validation of numbers given by users. Does not import PyTorch."""

from __future__ import annotations

import math
import operator
import re
from typing import Any

MAX_SEED = 2**63 - 1
"""Largest seed. The smallest is 0."""
MAX_COUNT = 10**12
"""Upper limit of counts, such as steps: beyond any practical run."""
MAX_ROVERS = 10**6
"""Upper limit of the number of rovers in a batch."""
MAX_NUMBER = 1e30
"""Upper limit of real-valued settings: products with 32-bit floats stay finite."""
MAX_SECONDS = 1e6
"""Longest drive that can be evaluated or filmed, s."""
NAME = "[A-Za-z_][A-Za-z0-9_]*"
"""Part of the name of a topic or a node of ROS 2, between two slashes."""
MAX_TOPIC = 247
"""Largest number of characters of a topic, as in ROS 2."""


def check_count(most: int, **counts: Any) -> int:
    """Returns a count of any integer type, given by its name, as an ``int``.

    Raises ``ValueError`` if it is not a whole number from 1 to ``most``.
    """
    ((name, count),) = counts.items()
    if not 1 <= (whole := _whole(count)) <= most:
        raise ValueError(f"{name} must be a whole number of at least 1 and at most {most}, got {count!r}")
    return whole


def check_seed(seed: Any, count: int = 1) -> int:
    """Returns a seed of any integer type as an ``int``.

    Raises ``ValueError`` if it is not a whole number, or it or one of the ``count`` seeds from it on is out of range.
    """
    most = MAX_SEED - count + 1
    if not 0 <= (whole := _whole(seed)) <= most:
        raise ValueError(f"seed must be a whole number from 0 to {most}, got {seed!r}")
    return whole


def _whole(number: Any) -> int:
    try:
        # operator.index(True) is 1, but a bool is most likely a mistake.
        return -1 if isinstance(number, bool) else operator.index(number)
    except TypeError:
        return -1


def check_at_least(least: float, most: float, **numbers: float) -> None:
    """Raises ``ValueError`` for the first number that is NaN or not between ``least`` and ``most``, with its name."""
    for name, number in numbers.items():
        if not least <= number <= most:
            raise ValueError(f"{name} must be at least {least:g} and at most {most:g}, got {number}")


def check_positive(most: float, **numbers: float) -> None:
    """Raises ``ValueError`` for the first number that is NaN, not positive or above ``most``, with its name."""
    for name, number in numbers.items():
        if not 0 < number <= most:
            limit = "" if most == math.inf else f" and at most {most:g}"
            raise ValueError(f"{name} must be positive{limit}, got {number}")


def check_topics(**topics: Any) -> None:
    """Raises ``ValueError`` for the first topic, by the name of its setting, that ROS 2 does not allow."""
    for name, topic in topics.items():
        if not (isinstance(topic, str) and len(topic) <= MAX_TOPIC and re.fullmatch(f"/?{NAME}(/{NAME})*", topic)):
            raise ValueError(
                f"{name} must be a topic of ROS 2, such as /scan or /robot1/scan: letters, digits and _ in parts that "
                f"begin with no digit, at most {MAX_TOPIC} characters, got {topic!r}"
            )
