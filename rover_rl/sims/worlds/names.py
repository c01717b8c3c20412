"""Names of worlds, ``NAME[:SEED][@DIFFICULTY]``, of ranges of them, for example ``maze:*``, and of world files."""

from __future__ import annotations

import re
from dataclasses import dataclass

TRAINING_SEEDS = 10_000
"""Number of seeds for training, from 0. By convention, seeds from 10,000 up are for evaluation."""

SDF_SUFFIXES = (".sdf", ".world")
MESH_SUFFIXES = (".obj", ".stl", ".dae", ".glb", ".gltf", ".ply")
TIFF_SUFFIXES = (".tif", ".tiff")
ELEVATION_SUFFIXES = (*TIFF_SUFFIXES, ".png", ".npy", ".pgm", ".jpg", ".jpeg", ".bmp")
MAP_SUFFIXES = (".yaml", ".yml")
ARCHIVE_SUFFIX = ".world.npz"
SUFFIXES = (*SDF_SUFFIXES, *MESH_SUFFIXES, *ELEVATION_SUFFIXES, *MAP_SUFFIXES, ARCHIVE_SUFFIX)
"""Suffixes of the files that worlds are read from."""

_RANGE = re.compile(r"(.+):(?:\*|([0-9]+)-([0-9]+))(?:@(.*))?", re.ASCII)
_LEVELS = re.compile(r"([0-9.]+)-([0-9.]+)", re.ASCII)
_GOLDEN_RATIO = (5**0.5 - 1) / 2


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

    def __str__(self) -> str:
        """Returns the name."""
        seed = "" if self.seed is None else f":{self.seed}"
        return f"{self.part}{seed}" + ("" if self.difficulty is None else f"@{self.difficulty:f}")

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


@dataclass(frozen=True)
class WorldRange:
    """Seeds of a world, named as ``NAME:FIRST-LAST``, or ``NAME:*`` for the seeds from 0 to 9999.

    A difficulty after ``@`` is a number or a range. In a range, each seed has its own difficulty, and those of
    consecutive seeds are spread evenly over it.

    Attributes:
        part: registered name, or ``module:attribute``.
        first: first seed.
        last: last seed.
        difficulty: lowest and highest difficulty; ``None`` without one.

    Example:
        >>> WorldRange.parse("maze:0-99@0.2-0.8").name(7)
        'maze:7@0.396'
    """

    part: str
    first: int
    last: int
    difficulty: tuple[float, float] | None = None

    @classmethod
    def parse(cls, text: str) -> WorldRange | None:
        """Splits the name of a range into its parts. Returns ``None`` for other names.

        Raises:
            ValueError: if the seeds or difficulties are not in order, or a difficulty is not a number from 0 to 1.
        """
        match = _RANGE.fullmatch(text)
        if match is None:
            return None
        part, first, last, level = match.groups()
        seeds = (0, TRAINING_SEEDS - 1) if first is None else (int(first), int(last))
        levels = None
        if level is not None:
            ends = _LEVELS.fullmatch(level)
            low, high = ends.groups() if ends else (level, level)
            levels = (_difficulty(text, low), _difficulty(text, high))
        if seeds[1] < seeds[0] or (levels and levels[1] < levels[0]):
            raise ValueError(f"the ends of {text!r} must be in order, as in '{part}:0-99@0.2-0.8'")
        return cls(part, *seeds, levels)

    def __len__(self) -> int:
        """Number of worlds."""
        return self.last - self.first + 1

    def name(self, number: int) -> str:
        """Returns the name of a world of the range, counted from 0."""
        seed = self.first + number
        if self.difficulty is None:
            return f"{self.part}:{seed}"
        low, high = self.difficulty
        # Multiples of the golden ratio, modulo 1, are spread evenly for any number of consecutive seeds.
        return f"{self.part}:{seed}@{low + seed * _GOLDEN_RATIO % 1 * (high - low):.3g}"


def is_world_file(name: str) -> bool:
    """Returns whether the name of a world is the path of a file: by its suffix, or because it has a folder."""
    return name.lower().endswith((*SUFFIXES, ".npz")) or "/" in name or "\\" in name


def unseen(name: str) -> str:
    """Returns a world for evaluation of a policy that was trained in the worlds ``name``.

    For a range, it has the first seed that is neither in the range nor for training. Other names stay unchanged.
    """
    seeds = WorldRange.parse(name)
    if seeds is None:
        return name
    first = max(TRAINING_SEEDS, seeds.last + 1)
    return WorldRange(seeds.part, first, first, seeds.difficulty).name(0)


def check_training_seed(name: str) -> None:
    """Raises a ``ValueError`` if a world, or one of a range, is for evaluation: has a seed of 10,000 or more."""
    seeds = WorldRange.parse(name)
    last = WorldName.parse(name).seed if seeds is None else seeds.last
    if last is not None and last >= TRAINING_SEEDS:
        raise ValueError(
            f"seeds from {TRAINING_SEEDS} up are for evaluation; train with lower ones, as in "
            f"{(seeds.part if seeds else WorldName.parse(name).part) + ':*'!r}, got {name!r}"
        )
