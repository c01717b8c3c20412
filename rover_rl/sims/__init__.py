"""What moves the rover. Each backend is one implementation of :class:`rover_rl.sims.base.Simulator`.

``RoverState`` and ``Simulator``, which need PyTorch, are imported when they are asked for.
"""

from __future__ import annotations

from collections.abc import Sequence
from importlib import import_module
from typing import TYPE_CHECKING, Any, Protocol, cast

from rover_rl.sims.connection import Connection

if TYPE_CHECKING:
    import torch

    from rover_rl.sims.base import RoverState, Simulator
    from rover_rl.sims.robots import Robot
    from rover_rl.sims.worlds import World

BACKENDS: dict[str, str] = {
    "bullet": "rover_rl.sims.bullet:BulletSettings",
    "ros2": "rover_rl.sims.ros2:Ros2Settings",
    "warp": "rover_rl.sims.warp:WarpSettings",
}
"""Backends by name: where the class of their settings is, so that only the one asked for is imported."""


class Backend(Protocol):
    """Settings that know how to build their simulator."""

    def make(
        self,
        *,
        worlds: Sequence[World],
        robot: Robot,
        lidar_beams: int,
        connection: Connection | None = None,
        device: torch.device | None = None,
    ) -> Simulator:
        """The simulator: see :func:`make_simulator`."""
        ...


def make_simulator(
    backend: str | Backend,
    *,
    worlds: Sequence[World],
    robot: Robot,
    lidar_beams: int,
    physics: str | None = None,
    connection: Connection | None = None,
    device: torch.device | None = None,
) -> Simulator:
    """Builds a simulator.

    Args:
        backend: a name in :data:`BACKENDS`, for a backend with its default settings, or its settings.
        worlds: the world of each rover, N entries; equal ones share a simulation.
        robot: the rover.
        lidar_beams: beams of a raw scan over the full turn.
        physics: name of a preset of a backend that is given by its name; ``None``: its default settings.
        connection: topics of a live rover; ``None``: the contract's.
        device: where the task's tensors are; a backend that can run there does. ``None``: the CPU.

    Raises:
        ValueError: for an unknown backend or preset.
    """
    if isinstance(backend, str):
        if backend not in BACKENDS:
            raise ValueError(f"unknown backend {backend!r}; use one of {sorted(BACKENDS)}")
        module, name = BACKENDS[backend].split(":")
        settings = getattr(import_module(module), name)
        if physics is not None and not hasattr(settings, "preset"):
            raise ValueError(f"backend {backend!r} has no presets of physics, got physics={physics!r}")
        backend = cast(Backend, settings() if physics is None else settings.preset(physics))
    elif physics is not None:
        raise ValueError(f"physics={physics!r} is for a backend given by its name; this one has settings of its own")
    return backend.make(worlds=worlds, robot=robot, lidar_beams=lidar_beams, connection=connection, device=device)


def __getattr__(name: str) -> Any:
    if name not in ("RoverState", "Simulator"):
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module("rover_rl.sims.base"), name)


__all__ = ["BACKENDS", "Backend", "Connection", "RoverState", "Simulator", "make_simulator"]
