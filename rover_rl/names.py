"""Names of worlds, robots and sensors: a part, and settings of what makes it, ``PART(setting=value, ...)``."""

from __future__ import annotations

import ast
import keyword
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, overload

TRAINING_SEEDS = 10_000
"""Number of seeds for training, from 0. By convention, seeds from 10,000 up are for evaluation."""
SCALES = (0.5, 10.0)
"""Smallest and largest scale of a world."""
SHORT = ("walkers", "seed", "difficulty", "scale")
"""Settings with a short form, in the order in which they follow the part."""

_FORMS = re.compile(
    r"(?P<part>.+?)(?P<walkers>\+walkers)?(?::(?P<seed>\*|\d+(?:-\d+)?))?(?:@(?P<difficulty>[^*()/\\]*))?"
    r"(?:\*(?P<scale>[^*@:()/\\]*))?(?P<settings>\(.*\))?",
    re.ASCII | re.DOTALL,
)
_FILE = re.compile(r".*\.[A-Za-z]\w*", re.ASCII | re.DOTALL)
"""A path: what is before the ending of a file is no short form."""
_NUMBER = r"\d*\.?\d+(?:e-\d+)?"
_GOLDEN_RATIO = (5**0.5 - 1) / 2


@dataclass(frozen=True)
class Name(Sequence["Name"]):
    """Name of a part with settings, or of a range of them.

    Some settings have short forms, which stand between the part and the parentheses, in this order:

    - ``maze+walkers`` is ``walkers=True``
    - ``maze:7`` is ``seed=7``
    - ``maze:0-99`` and ``maze:*`` are the ranges ``seed=(0, 99)`` and ``seed=(0, 9999)``
    - ``maze:7@0.8`` is ``difficulty=0.8``, from 0 to 1
    - ``maze:0-99@0.2-0.8`` is ``difficulty=(0.2, 0.8)``: each seed has its own, spread evenly
    - ``maze:7*1.6`` is ``scale=1.6``, from 0.5 to 10

    As a sequence, it has a name for each seed of its range; one without a range is its only item. ``part`` is a
    registered name, ``module:attribute``, or the path of a file.

    Example:
        >>> Name.parse("my_package:canyon:7@0.3*1.6")
        Name(part='my_package:canyon', settings={'seed': 7, 'difficulty': 0.3, 'scale': 1.6})
        >>> Name.parse("depth(size=(24, 32), period=2)").settings["size"]
        (24, 32)
        >>> maze = Name.parse("maze:0-99@0.2-0.8")
        >>> len(maze), str(maze[7]), str(maze[7].replace(difficulty=None, scale=2))
        (100, 'maze:7@0.396', 'maze:7*2')
    """

    part: str
    settings: Mapping[str, Any] = field(default_factory=dict)

    @classmethod
    def parse(cls, text: str) -> Name:
        """Reads a name. Values in parentheses are literals of Python, or words; nothing is executed.

        Raises ``ValueError`` if they are something else, a setting with a short form is out of range, or the ends of a
        range are not in order.
        """
        forms = None if _FILE.fullmatch(text) else _FORMS.fullmatch(text)
        if forms is None:
            return cls(text)
        if forms["part"].endswith(":") and forms["scale"]:
            raise ValueError(f"{text!r} lacks a '*': that of all seeds, and that of the scale, as in 'maze:**1.6'")
        settings: dict[str, Any] = {"walkers": True} if forms["walkers"] else {}
        if seed := forms["seed"]:
            ends = (0, TRAINING_SEEDS - 1) if seed == "*" else tuple(map(int, seed.split("-")))
            settings["seed"] = ends if len(ends) > 1 else ends[0]
        if (level := forms["difficulty"]) is not None:
            numbers = re.fullmatch(f"({_NUMBER})(?:-({_NUMBER}))?", level)
            levels = tuple(float(end) for end in numbers.groups() if end) if numbers else (level,)
            settings["difficulty"] = levels if len(levels) > 1 else levels[0]
        if (scale := forms["scale"]) is not None:
            settings["scale"] = float(scale) if re.fullmatch(_NUMBER, scale) else scale
        name = cls(forms["part"], settings | _in_parentheses(text, forms["settings"] or "()"))
        name._check(text)
        return name

    def _check(self, text: str) -> None:
        for setting, (low, high) in {"difficulty": (0, 1), "scale": SCALES, "seed": (0, math.inf)}.items():
            value = self.settings.get(setting, low)
            ends = value if isinstance(value, tuple) and setting != "scale" else (value,)
            kind = int if setting == "seed" else (int, float)
            if not all(isinstance(end, kind) and low <= end <= high for end in ends):
                allowed = "a whole number" if setting == "seed" else f"a number from {low:g} to {high:g}"
                raise ValueError(f"the {setting} of {text!r} must be {allowed}, got {str(value)!r}")
            if len(ends) > 2 or ends[0] > ends[-1]:
                raise ValueError(f"the ends of {text!r} must be in order, as in '{self.part}:0-99@0.2-0.8'")

    def __str__(self) -> str:
        rest = dict(self.settings)
        walkers, seed, level, scale = (rest.pop(setting, None) for setting in SHORT)
        short = "+walkers" if walkers else ""
        for sign, value in ((":", seed), ("@", level), ("*", scale)):
            ends = value if isinstance(value, tuple) else (value,)
            short += "" if value is None else sign + "-".join(f"{end:.12g}" for end in ends)
        short = short.replace(f":0-{TRAINING_SEEDS - 1}", ":*")
        long = ", ".join(f"{setting}={_literal(value)}" for setting, value in rest.items())
        return self.part + short + (f"({long})" if long else "")

    def __hash__(self) -> int:
        return hash(str(self))

    def replace(self, **settings: Any) -> Name:
        """Returns the name with other settings, and without those that are ``None``."""
        merged = {**self.settings, **settings}
        return Name(self.part, {setting: value for setting, value in merged.items() if value is not None})

    @property
    def is_range(self) -> bool:
        """Whether the name is that of a range of seeds, perhaps of one."""
        return isinstance(self.settings.get("seed"), tuple)

    def __len__(self) -> int:
        first, last = self.settings["seed"] if self.is_range else (0, 0)
        return last - first + 1

    @overload
    def __getitem__(self, index: int) -> Name: ...

    @overload
    def __getitem__(self, index: slice) -> list[Name]: ...

    def __getitem__(self, index: int | slice) -> Name | list[Name]:
        if isinstance(index, slice):
            return [self[k] for k in range(*index.indices(len(self)))]
        if not 0 <= index < len(self):
            raise IndexError(f"{self} stands for {len(self)} names, got index {index}")
        if not self.is_range:
            return self
        seed, level = self.settings["seed"][0] + index, self.settings.get("difficulty")
        if isinstance(level, tuple):
            # Multiples of the golden ratio, modulo 1, are spread evenly for any number of consecutive seeds.
            level = float(f"{level[0] + seed * _GOLDEN_RATIO % 1 * (level[1] - level[0]):.3g}")
        return self.replace(seed=seed, difficulty=level)


def unseen(text: str) -> str:
    """Returns a name with the first seed that is neither in a range nor for training; other names unchanged."""
    name = Name.parse(text)
    if not name.is_range:
        return text
    first = max(TRAINING_SEEDS, name.settings["seed"][1] + 1)
    return str(name.replace(seed=(first, first))[0])


def check_training_seed(text: str) -> None:
    """Raises a ``ValueError`` if a name, or one of a range, is for evaluation: has a seed of 10,000 or more."""
    name = Name.parse(text)
    seed = name.settings.get("seed", 0)
    if (seed[1] if name.is_range else seed) >= TRAINING_SEEDS:
        raise ValueError(
            f"seeds from {TRAINING_SEEDS} up are for evaluation; train with lower ones, as in '{name.part}:*', "
            f"got {text!r}"
        )


def _in_parentheses(text: str, settings: str) -> dict[str, Any]:
    try:
        call = ast.parse(f"_{settings}", mode="eval").body
        if not isinstance(call, ast.Call) or call.args or not isinstance(call.func, ast.Name):
            raise ValueError
        return {
            str(one.arg): one.value.id if isinstance(one.value, ast.Name) else ast.literal_eval(one.value)
            for one in call.keywords
        }
    except (SyntaxError, ValueError) as error:
        raise ValueError(
            f"settings are NAME(setting=value, ...) with numbers, texts and tuples, got {text!r}"
        ) from error


def _literal(value: Any) -> str:
    is_word = isinstance(value, str) and value.isidentifier() and not keyword.iskeyword(value)
    return value if is_word else repr(value)
