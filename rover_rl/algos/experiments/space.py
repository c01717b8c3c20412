"""Settings that a sweep varies, as words of the command line. Imports no PyTorch.

Example:
    >>> for setting in read_space(["learning_rate=1e-4..3e-3", "gamma=0.95,0.97"], training_config("ppo")):
    ...     print(setting)
    learning_rate: from 0.0001 to 0.003, log-uniform
    gamma: 0.95 or 0.97
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from functools import reduce
from itertools import chain
from operator import getitem
from typing import Any, TypeAlias

import yaml

from rover_rl.algos.config import TrainingConfig
from rover_rl.algos.config_files import config_from, plain

FORM = "NAME=LOW..HIGH or NAME=A,B,C"  # form of a word
_LOG_SPAN = 10.0  # ratio of the ends of a range from which values are drawn log-uniformly
_FIXED = ("algo", "seed", "name", "runs", "logger", "snapshots", "checkpoint_minutes")
"""Settings that a sweep does not vary."""


@dataclass(frozen=True)
class Interval:
    """Setting that is drawn from an interval."""

    name: str
    low: float
    high: float
    whole: bool

    @property
    def log(self) -> bool:
        """Whether logarithms are drawn uniformly: if the ends differ by a factor of ten or more."""
        return self.low > 0 and self.high / self.low >= _LOG_SPAN * (1 - 1e-9)

    def value(self, drawn: float) -> float:
        """Returns the setting for a number that was drawn, with three digits if it is no whole number."""
        return int(drawn) if self.whole else min(max(float(f"{drawn:.3g}"), self.low), self.high)

    def __str__(self) -> str:
        kind = "log-uniform" if self.log else "uniform"
        return f"{self.name}: from {self.low:g} to {self.high:g}, {'whole numbers, ' * self.whole}{kind}"

    def distribution(self) -> Any:
        """Returns Optuna's distribution of what is drawn."""
        from optuna.distributions import FloatDistribution, IntDistribution

        kind: Any = IntDistribution if self.whole else FloatDistribution
        return kind(self.low, self.high, log=self.log)


@dataclass(frozen=True)
class Choice:
    """Setting that is one of several values."""

    name: str
    values: dict[str, Any]

    def value(self, drawn: str) -> Any:
        """Returns the setting for a text that was drawn."""
        return self.values[drawn]

    def __str__(self) -> str:
        return f"{self.name}: {' or '.join(self.values)}"

    def distribution(self) -> Any:
        """Returns Optuna's distribution of the texts."""
        from optuna.distributions import CategoricalDistribution

        return CategoricalDistribution([*self.values])


Setting: TypeAlias = "Interval | Choice"


def read_space(words: Sequence[str], config: TrainingConfig) -> list[Setting]:
    """Reads the settings to vary, and checks the ends of intervals and all choices, each by itself.

    A word is ``NAME=LOW..HIGH`` for an interval, or ``NAME=A,B,C`` for a choice. Names are those of the sections of
    ``config.yaml``; settings within others have dots, as in ``lidar.points``.

    Raises:
        ValueError: for an unknown setting, a value of the wrong type or out of range, or another form.
    """
    if not words:
        raise ValueError(f"name the settings to vary: --vary {FORM}")
    space = [_read(word, config) for word in words]
    if len({setting.name for setting in space}) < len(space):
        raise ValueError(f"vary each setting once, got {' '.join(words)}")
    for setting in space:
        ends = [*setting.values] if isinstance(setting, Choice) else [setting.low, setting.high]
        for end in ends:
            with_varied(config, {setting.name: setting.value(end)}).check()  # type: ignore[arg-type]
    return space


def _read(word: str, config: TrainingConfig) -> Setting:
    name, equals, text = word.partition("=")
    name = name.strip().lstrip("-").replace("-", "_")
    places = _places(config)
    if not equals or not text.strip():
        raise ValueError(f"--vary takes {FORM}, got {word!r}")
    if name not in places:
        similar = get_close_matches(name, places, n=1)
        hint = f", perhaps {similar[0]}" if similar else f"; use some of {sorted(places)}"
        raise ValueError(f"{config.algo} has no setting {name!r} to vary{hint}")
    ends = re.fullmatch(r"(.+?)\.\.(.+)", text)
    if ends is None:
        # A comma within brackets is part of a value: hidden=[64,64],[128,128].
        values = [value.strip() for value in re.split(r",(?![^\[]*\])", text)]
        return Choice(name, {value: _value(value) for value in values})
    low, high = (_value(end) for end in ends.groups())
    numbers = all(isinstance(end, int | float) and not isinstance(end, bool) for end in (low, high))
    if not (numbers and low < high):
        raise ValueError(f"the ends of {word!r} must be numbers, the smaller one first")
    current = reduce(getitem, places[name], plain(config))
    if isinstance(current, bool | str | list | dict):
        raise ValueError(f"{name} is no number: vary it as {name}=A,B,C")
    integer = isinstance(low, int) and isinstance(high, int)
    if isinstance(current, int) and not integer:
        raise ValueError(f"{name} is a whole number, got {text}")
    return Interval(name, low, high, integer and not isinstance(current, float))


def with_varied(config: TrainingConfig, values: Mapping[str, Any]) -> TrainingConfig:
    """Returns ``config`` with other settings, by their names with dots."""
    data, places = plain(config), _places(config)
    for name, value in values.items():
        *parts, last = places[name]
        reduce(getitem, parts, data)[last] = value
    return config_from(data, "--vary")


def _value(text: str) -> Any:
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            pass
    try:
        return yaml.safe_load(text)
    except yaml.YAMLError as error:
        raise ValueError(f"--vary takes {FORM}, got the value {text!r}") from error


def _places(config: TrainingConfig) -> dict[str, tuple[str, ...]]:
    found = _paths(plain(config))
    places = {".".join(path[1:]): path for path in found if len(path) > 1}
    return {name: path for name, path in places.items() if name not in _FIXED}


def _paths(data: Any, path: tuple[str, ...] = ()) -> list[tuple[str, ...]]:
    below = [_paths(value, (*path, key)) for key, value in data.items()] if isinstance(data, dict) else []
    return [path, *chain.from_iterable(below)]
