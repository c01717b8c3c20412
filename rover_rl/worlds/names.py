"""Names of worlds, ``NAME[:SEED][@DIFFICULTY][*SCALE]``, of ranges, for example ``maze:*``, and of world files."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace

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

SCALES = (0.5, 10)
"""Smallest and largest scale of a world."""

_RANGE = re.compile(r"(.+):(?:\*|([0-9]+)-([0-9]+))(?:@(.*))?", re.ASCII)
_SCALE = re.compile(r"(.*[^:])\*([^*:@]*)", re.ASCII)
_LEVELS = re.compile(r"([0-9.]+)-([0-9.]+)", re.ASCII)
_GOLDEN_RATIO = (5**0.5 - 1) / 2


@dataclass(frozen=True)
class WorldName:
    """Parts of the name of a world.

    Attributes:
        part: registered name, or ``module:attribute``.
        seed: seed after the colon; ``None`` without one.
        difficulty: difficulty in [0, 1] after the ``@``; ``None`` without one.
        scale: factor of the width of passages after the ``*``; ``None`` without one.

    Example:
        >>> WorldName.parse("my_package:canyon:7@0.3*1.6")
        WorldName(part='my_package:canyon', seed=7, difficulty=0.3, scale=1.6)
    """

    part: str
    seed: int | None = None
    difficulty: float | None = None
    scale: float | None = None

    def __str__(self) -> str:
        """Returns the name."""
        seed = "" if self.seed is None else f":{self.seed}"
        level = "" if self.difficulty is None else f"@{self.difficulty:f}"
        return f"{self.part}{seed}{level}" + _ending(self.scale)

    @classmethod
    def parse(cls, text: str) -> WorldName:
        """Splits a name into its parts. A text after the last colon that is no seed belongs to ``part``.

        Raises:
            ValueError: if the text after ``@`` is not a number from 0 to 1, or that after ``*`` none from 0.5 to 10.
        """
        name, scale = _split_scale(text)
        name, at, level = name.partition("@")
        difficulty = _difficulty(text, level) if at else None
        part, _, seed = name.rpartition(":")
        if part and seed.isascii() and seed.isdigit():
            return cls(part, int(seed), difficulty, scale)
        return cls(name, None, difficulty, scale)


def _difficulty(text: str, level: str) -> float:
    if not re.fullmatch(r"[0-9]*\.?[0-9]+", level, re.ASCII) or not 0 <= float(level) <= 1:
        raise ValueError(f"the difficulty of world {text!r} must be a number from 0 to 1, got {level!r}")
    return float(level)


def _split_scale(text: str) -> tuple[str, float | None]:
    """Splits the scale from a name."""
    match = _SCALE.fullmatch(text)
    if match is None:
        if re.fullmatch(r".+:\*[0-9.]+", text):
            raise ValueError(f"{text!r} lacks a '*': that of all seeds, and that of the scale, as in 'maze:**1.6'")
        return text, None
    name, scale = match.groups()
    if not re.fullmatch(r"[0-9]*\.?[0-9]+", scale, re.ASCII) or not SCALES[0] <= float(scale) <= SCALES[1]:
        raise ValueError(f"the scale of world {text!r} must be a number from {SCALES[0]} to {SCALES[1]}, got {scale!r}")
    return name, float(scale)


def _ending(scale: float | None) -> str:
    """Returns the end of the name of a world with a scale."""
    return "" if scale is None else f"*{scale:g}"


@dataclass(frozen=True)
class WorldRange:
    """Seeds of a world, named as ``NAME:FIRST-LAST``, or ``NAME:*`` for the seeds from 0 to 9999.

    A difficulty after ``@`` is a number or a range. In a range, each seed has its own difficulty, and those of
    consecutive seeds are spread evenly over it. A scale after ``*`` is that of all of them.

    Attributes:
        part: registered name, or ``module:attribute``.
        first: first seed.
        last: last seed.
        difficulty: lowest and highest difficulty; ``None`` without one.
        scale: factor of the width of passages; ``None`` without one.

    Example:
        >>> WorldRange.parse("maze:0-99@0.2-0.8").name(7)
        'maze:7@0.396'
    """

    part: str
    first: int
    last: int
    difficulty: tuple[float, float] | None = None
    scale: float | None = None

    @classmethod
    def parse(cls, text: str) -> WorldRange | None:
        """Splits the name of a range into its parts. Returns ``None`` for other names.

        Raises:
            ValueError: if the seeds or difficulties are not in order, a difficulty is not a number from 0 to 1, or a
                scale none from 0.5 to 10.
        """
        name, scale = _split_scale(text)
        match = _RANGE.fullmatch(name)
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
        return cls(part, *seeds, levels, scale)

    def __len__(self) -> int:
        """Number of worlds."""
        return self.last - self.first + 1

    def name(self, number: int) -> str:
        """Returns the name of a world of the range, counted from 0."""
        seed = self.first + number
        if self.difficulty is None:
            return f"{self.part}:{seed}{_ending(self.scale)}"
        low, high = self.difficulty
        # Multiples of the golden ratio, modulo 1, are spread evenly for any number of consecutive seeds.
        return f"{self.part}:{seed}@{low + seed * _GOLDEN_RATIO % 1 * (high - low):.3g}{_ending(self.scale)}"


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
    return replace(seeds, first=first, last=first).name(0)


def check_training_seed(name: str) -> None:
    """Raises a ``ValueError`` if a world, or one of a range, is for evaluation: has a seed of 10,000 or more."""
    seeds = WorldRange.parse(name)
    last = WorldName.parse(name).seed if seeds is None else seeds.last
    if last is not None and last >= TRAINING_SEEDS:
        raise ValueError(
            f"seeds from {TRAINING_SEEDS} up are for evaluation; train with lower ones, as in "
            f"{(seeds.part if seeds else WorldName.parse(name).part) + ':*'!r}, got {name!r}"
        )
