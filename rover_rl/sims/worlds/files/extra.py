"""Imports of the packages of the extra ``worlds``."""

from __future__ import annotations

from importlib import import_module
from typing import Any


def optional(module: str) -> Any:
    """Imports a module of the extra ``worlds``.

    Raises:
        ImportError: if the package is not installed. The message says how to install it.
    """
    try:
        return import_module(module)
    except ImportError as error:
        raise ImportError(f'this world file needs the package {module}: pip install "rover_rl[worlds]"') from error
