"""What moves the rover. Each backend is one implementation of :class:`rover_rl.sims.base.Simulator`."""

from __future__ import annotations

from collections.abc import Sequence
from importlib import import_module

from rover_rl.sims.base import RoverState, Simulator
from rover_rl.sims.robots import Robot
from rover_rl.sims.worlds import World

BACKENDS: dict[str, str] = {"bullet": "rover_rl.sims.bullet:BulletSimulator"}
"""Backends by name: where their class is, so that only the one asked for is imported."""


def make_simulator(backend: str, *, worlds: Sequence[World], robot: Robot, lidar_beams: int) -> Simulator:
    """Builds the simulator of that name.

    Args:
        backend: a name in :data:`BACKENDS`.
        worlds: the world of each rover, N entries; equal ones share a simulation.
        robot: the rover.
        lidar_beams: beams of a raw scan over the full turn.

    Raises:
        ValueError: for an unknown backend.
    """
    if backend not in BACKENDS:
        raise ValueError(f"unknown backend {backend!r}; use one of {sorted(BACKENDS)}")
    module, name = BACKENDS[backend].split(":")
    return getattr(import_module(module), name)(worlds=worlds, robot=robot, lidar_beams=lidar_beams)


__all__ = ["BACKENDS", "RoverState", "Simulator", "make_simulator"]
