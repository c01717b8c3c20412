"""Names of worlds: ``NAME[:SEED][@DIFFICULTY]``, for example ``maze:7@0.3``."""

from __future__ import annotations

import re
from dataclasses import dataclass


@dataclass(frozen=True)
class WorldName:
    """Parts of the name of a world.

    Attributes:
        part: registered name, or ``module:attribute``.
        seed: seed after the colon; ``None`` without one.
        difficulty: difficulty in [0, 1] after the ``@``; ``None`` without one.

    Example:
        >>> WorldName.parse("my_package:canyon:7@0.3")
        WorldName(part='my_package:canyon', seed=7, difficulty=0.3)
    """

    part: str
    seed: int | None = None
    difficulty: float | None = None

    @classmethod
    def parse(cls, text: str) -> WorldName:
        """Splits a name into its parts. A text after the last colon that is no seed belongs to ``part``.

        Raises:
            ValueError: if the text after ``@`` is not a number from 0 to 1.
        """
        name, at, level = text.partition("@")
        difficulty = _difficulty(text, level) if at else None
        part, _, seed = name.rpartition(":")
        if part and seed.isascii() and seed.isdigit():
            return cls(part, int(seed), difficulty)
        return cls(name, None, difficulty)


def _difficulty(text: str, level: str) -> float:
    if not re.fullmatch(r"[0-9]*\.?[0-9]+", level, re.ASCII) or not 0 <= float(level) <= 1:
        raise ValueError(f"the difficulty of world {text!r} must be a number from 0 to 1, got {level!r}")
    return float(level)
