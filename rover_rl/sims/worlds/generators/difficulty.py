"""Difficulty of layouts: a number in [0, 1] that scales the parameters of a generator."""

from __future__ import annotations

DEFAULT = 0.5
"""Difficulty without a choice."""


def check_difficulty(difficulty: float) -> None:
    """Checks a difficulty.

    Raises:
        ValueError: if it is not in [0, 1].
    """
    if not 0 <= difficulty <= 1:
        raise ValueError(f"difficulty must be a number from 0 to 1, got {difficulty}")


def scaled(difficulty: float, easy: float, default: float, hard: float) -> float:
    """Returns a parameter at a difficulty, piecewise linear between its values at 0, 0.5 and 1.

    The value at 0.5 is exactly ``default``.
    """
    if difficulty == DEFAULT:
        return default
    share = abs(difficulty - DEFAULT) / DEFAULT
    return default + share * ((hard if difficulty > DEFAULT else easy) - default)
