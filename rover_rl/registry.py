"""Registry: parts of an environment (worlds, robots, rewards, backends) by name.

A name is looked up among the parts of the package, those that were registered, the entry points of installed packages,
and as ``module:attribute``. Imports no PyTorch.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Mapping
from importlib import import_module
from importlib.metadata import entry_points
from typing import Any


class Registry:
    """Parts of one kind, by name.

    Args:
        kind: what a part is called in messages, for example ``"world"``.
        built_in: the package's own parts. A value ``"module:attribute"`` is imported when it is asked for.
        also: what else than a name is allowed, for the message about an unknown name.

    Entry points of installed packages are in the group ``rover_rl.KINDs``, for example ``rover_rl.worlds``::

        [project.entry-points."rover_rl.worlds"]
        canyon = "my_package.worlds:canyon"
    """

    def __init__(
        self, kind: str, built_in: Mapping[str, Any], also: str = ", or 'module:attribute' of your own"
    ) -> None:
        self._kind, self._also = kind, also
        self._parts = dict(built_in)

    def register(self, name: str, part: Any) -> None:
        """Adds a part.

        Args:
            name: letters, digits, ``_``, ``-`` and ``.``.
            part: the part, or ``"module:attribute"``, which is imported when it is asked for.

        Raises:
            ValueError: for another name, or one that is taken by another part.
        """
        if not re.fullmatch(r"[\w.-]+", name):
            raise ValueError(f"the name of a {self._kind} must be letters, digits, '_', '-' and '.', got {name!r}")
        if self._parts.get(name, part) is not part:
            raise ValueError(f"there is a {self._kind} {name!r} already; choose another name")
        self._parts[name] = part

    def names(self) -> list[str]:
        """All names, sorted, without those in the form ``module:attribute``."""
        return sorted({*self._parts, *(entry.name for entry in self._entry_points())})

    def find(self, name: str) -> Any:
        """The part of that name.

        Raises:
            ValueError: for an unknown name, or one whose module or attribute does not exist.
        """
        if name in self._parts:
            part = self._parts[name]
            return self._imported(name, part) if isinstance(part, str) else part
        for entry in self._entry_points():
            if entry.name == name:
                return self._imported(name, entry.value)
        if is_path(name):
            self._refuse_standard_library(name)
            return self._imported(name, name)
        raise ValueError(self._unknown(name))

    def _unknown(self, name: str) -> str:
        return f"unknown {self._kind} {name!r}; use one of {self.names()}{self._also}"

    def _entry_points(self) -> Any:
        return entry_points(group=f"rover_rl.{self._kind}s")

    def _imported(self, name: str, path: str) -> Any:
        module, _, attribute = path.partition(":")
        try:
            part: Any = import_module(module)
        except ImportError as error:
            if isinstance(error, ModuleNotFoundError) and error.name == module.split(".")[0]:
                raise ValueError(self._unknown(name)) from error
            raise ValueError(f"{self._kind} {name!r} cannot be imported: {error}") from error
        for step in attribute.split("."):
            if not hasattr(part, step):
                raise ValueError(f"{self._kind} {name!r} cannot be imported: {module!r} has no {attribute!r}")
            part = getattr(part, step)
        return part

    def _refuse_standard_library(self, name: str) -> None:
        # Names also come from checkpoints of others: "os:abort" must not be called because a file says so.
        if name.split(":")[0].split(".")[0] in sys.stdlib_module_names:
            raise ValueError(f"{self._kind} {name!r} is in Python's standard library, which has none")


def is_path(name: str) -> bool:
    """Whether a name has the form ``module:attribute``."""
    return re.fullmatch(r"[^\W\d][\w.]*:[^\W\d][\w.]*", name) is not None
