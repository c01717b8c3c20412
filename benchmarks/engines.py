"""Simulators that the benchmarks compare."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from rover_rl.robots import get_robot
from rover_rl.sims import Backend, make_simulator
from rover_rl.sims.backends import BACKENDS, resolve_backend
from rover_rl.worlds import Terrain, World


def installed_engines() -> list[str]:
    """Names of the simulators of the package whose libraries are installed, Bullet first."""
    # A live rover is no simulator.
    engines = sorted((name for name in BACKENDS if name != "ros2"), key=lambda name: (name != "bullet", name))
    return [name for name in engines if _is_installed(name)]


def _is_installed(name: str) -> bool:
    """Builds a simulator of one rover, which fails if a library is missing."""
    world = World("flat", Terrain.flat((4, 4)))
    try:
        make_simulator(name, worlds=[world], robot=get_robot("rover_zero")).close()
    except ImportError:
        return False
    return True


def choose_engines(names: tuple[str, ...]) -> list[str]:
    """The named simulators, or all installed ones if none is named. Raises an error for others."""
    for name in names:
        resolve_backend(name)
    return list(dict.fromkeys(names)) or installed_engines()


def with_friction(engine: Any, friction: float) -> Backend:
    """Settings of a simulator, given by name or settings, with another friction on the ground."""
    return replace(resolve_backend(engine), ground_friction=friction)
