"""Importers of worlds: SDF, meshes, elevation models, occupancy grids, and the project's own world files."""

from __future__ import annotations

from importlib import import_module
from typing import Any


def optional(module: str) -> Any:
    """Imports a module of the extra ``worlds``. If it is not installed, the error says how to install it."""
    try:
        return import_module(module)
    except ImportError as error:
        raise ImportError(f'this world file needs the package {module}: pip install "rover_rl[worlds]"') from error
