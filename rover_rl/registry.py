"""Registry of the parts of an environment (worlds, robots, sensors, rewards, tasks, ...) by name.

A name refers to a built-in part, a registered part, an entry point of an installed package, or a Python object in the
form ``module:attribute``, in this order. Does not import PyTorch.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Callable, Iterable, Mapping
from difflib import get_close_matches
from importlib import import_module
from importlib.metadata import entry_points
from importlib.util import find_spec
from inspect import signature
from types import ModuleType
from typing import Any

from rover_rl.names import Name


class Registry:
    """Parts of one kind, by name.

    ``kind`` is its name in error messages, for example ``"world"``. A built-in part ``"module:attribute"`` is imported
    on first use. ``also`` says what is accepted besides a name.

    Installed packages add parts with entry points in the group ``rover_rl.<kind>s``, for example ``rover_rl.worlds``::

        [project.entry-points."rover_rl.worlds"]
        canyon = "my_package.worlds:canyon"
    """

    def __init__(
        self, kind: str, built_in: Mapping[str, Any], also: str = ", or 'module:attribute' of your own"
    ) -> None:
        self._kind, self._also = kind, also
        self._parts = dict(built_in)

    def register(self, name: str, part: Any) -> None:
        """Registers a part, or its ``"module:attribute"``, which is imported on first use."""
        if not re.fullmatch(r"[\w.-]+", name):
            allowed = "letters, digits, '_', '-' and '.'"
            raise ValueError(f"the name of a {self._kind} must consist of {allowed}, got {name!r}")
        if self._parts.get(name, part) is not part:
            raise ValueError(f"a {self._kind} named {name!r} already exists; choose another name")
        self._parts[name] = part

    def names(self) -> list[str]:
        return sorted({*self._parts, *(entry.name for entry in self._entry_points())})

    def find(self, name: str) -> Any:
        """Returns a part. Raises ``ValueError`` if its name is unknown, or it cannot be imported."""
        if name in self._parts:
            part = self._parts[name]
            return self._import(name, part) if isinstance(part, str) else part
        for entry in self._entry_points():
            if entry.name == name:
                return self._import(name, entry.value)
        if is_path(name):
            self._check_not_standard_library(name, name.split(":")[0])
            return self._import(name, name)
        raise ValueError(self._unknown(name, name))

    def call(self, name: str, factory: Callable[..., Any], /, *arguments: Any, **settings: Any) -> Any:
        """Calls the function or class that makes the part ``name``. Names it if it does not take these arguments."""
        try:
            signature(factory).bind(*arguments, **settings)
        except TypeError as error:
            given = f"the settings {[*settings]}" if settings else f"{len(arguments)} arguments"
            raise ValueError(f"{self._kind} {name!r} is called with {given}: {error}") from error
        try:
            return factory(*arguments, **settings)
        except TypeError as error:
            if not settings:
                raise
            raise ValueError(f"{self._kind} {name!r} does not take the settings {settings}: {error}") from error

    def make(self, given: Any, kind: type) -> Any:
        """Returns a part of a class ``kind``: ``given``, or what the name, class or function that is given makes.

        A name may have settings, as in ``"depth(size=(24, 32))"``. Raises ``ValueError`` for anything else.
        """
        name = Name.parse(given) if isinstance(given, str) else Name(str(given))
        part = self.find(name.part) if isinstance(given, str) else given
        if callable(part) and not isinstance(part, kind):
            part = self.call(name.part, part, **name.settings)
        elif name.settings:
            raise ValueError(f"{self._kind} {name.part!r} has its settings already, and takes none, got {given!r}")
        if not isinstance(part, kind):
            a = f"a{'n' * (self._kind[0] in 'aeiou')} {self._kind}"
            raise ValueError(f"{a} must be a {kind.__name__}, or a function or class that makes one, got {part!r}")
        return part

    def _unknown(self, name: str, path: str) -> str:
        known = self.names()
        named = is_path(path) and path.split(":")[0] not in known
        advice = (_module_advice(path) if named else perhaps(name, known)) or _module_advice(path)
        return f"unknown {self._kind} {name!r}{advice}; use one of {known}{self._also}"

    def _entry_points(self) -> Any:
        return entry_points(group=f"rover_rl.{self._kind}s")

    def _import(self, name: str, path: str) -> Any:
        module, _, attribute = path.partition(":")
        try:
            part: Any = import_module(module)
        except ImportError as error:
            if isinstance(error, ModuleNotFoundError) and error.name == module.split(".")[0]:
                raise ValueError(self._unknown(name, path)) from error
            raise ValueError(f"{self._kind} {name!r} cannot be imported: {error}") from error
        for step in attribute.split("."):
            # What a module imports is not its own: "my_package.files:os.abort" must not be called either.
            if not hasattr(part, step) or isinstance(getattr(part, step), ModuleType):
                raise ValueError(f"{self._kind} {name!r} cannot be imported: {module!r} has no {attribute!r}")
            part = getattr(part, step)
        self._check_not_standard_library(name, getattr(part, "__module__", None) or module)
        return part

    def _check_not_standard_library(self, name: str, module: str) -> None:
        # Names also come from checkpoints of other users, which must not call functions such as "os:abort".
        if module.split(".")[0] in sys.stdlib_module_names:
            raise ValueError(f"{self._kind} {name!r} is in Python's standard library, which has no {self._kind}s")


def perhaps(name: str, known: Iterable[str]) -> str:
    """Returns the end of a message about an unknown name: the most similar known name, or nothing."""
    similar = get_close_matches(name, [*known], n=1)
    return f", perhaps {similar[0]!r}" if similar else ""


def _module_advice(name: str) -> str:
    module, _, attribute = name.replace(":", ".").rpartition(".")
    if not is_path(f"{module}:{attribute}"):
        return ""
    top = module.split(".")[0]
    if top not in sys.modules and find_spec(top) is None:
        return f": there is no module {top!r}"
    return "" if is_path(name) else f", perhaps '{module}:{attribute}'"


def is_path(name: str) -> bool:
    """Returns whether a name has the form ``module:attribute``."""
    return re.fullmatch(r"[^\W\d][\w.]*:[^\W\d][\w.]*", name) is not None
