"""Simulators of the rovers, one of which is a real rover: implementations of :class:`Simulator`."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from rover_rl.sims.backends import Backend, backend_names, make_scanner, make_simulator, register_backend

if TYPE_CHECKING:
    from rover_rl.sims.base import RoverState, Simulator

__all__ = ["Backend", "RoverState", "Simulator", "backend_names", "make_scanner", "make_simulator", "register_backend"]


def __getattr__(name: str) -> Any:
    # They need PyTorch.
    if name not in ("RoverState", "Simulator"):
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module("rover_rl.sims.base"), name)
