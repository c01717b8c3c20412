"""MuJoCo backend: batched rovers in one or several worlds, on several threads."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import cache, partial

import numpy as np
import torch

from rover_rl.native.mujoco import mujoco
from rover_rl.robots import Robot
from rover_rl.sims.movers.near import NearParts
from rover_rl.sims.mujoco import MujocoSettings
from rover_rl.sims.mujoco.model import make_model
from rover_rl.sims.mujoco.physics import RoverPhysics, RoversAmongMovers, reach_of, slots_of
from rover_rl.sims.rover_state import Force
from rover_rl.sims.world_groups import GroupedSimulator, WorldGroup
from rover_rl.worlds import World
from rover_rl.worlds.movers import Part

MIN_ROVERS_PER_THREAD = 4
"""Minimum number of rovers per thread; with fewer, another thread does not pay."""


class MujocoSimulator(GroupedSimulator):
    """Simulator in MuJoCo. Rovers in the same world share models.

    ``worlds`` holds the world of each rover. Without ``settings``, the physics has its defaults.
    """

    def __init__(self, worlds: Sequence[World], robot: Robot, settings: MujocoSettings | None = None) -> None:
        settings = settings or MujocoSettings()
        self._models = cache(partial(make_model, robot, settings.for_mass(robot.mass)))
        threads = settings.threads or torch.get_num_threads()
        super().__init__(worlds, robot, settings, min(threads, max(1, len(worlds) // MIN_ROVERS_PER_THREAD)))

    def _group(self, world: World, rows: slice) -> WorldGroup:
        return MujocoGroup(world, rows, self._robot, self.settings, self._models)


class MujocoGroup(WorldGroup):
    """Rovers in one world, on one thread.

    Rovers near movers are simulated in a model that has their parts, too. ``models`` makes models of a rover in a
    world, with parts of movers, which measure fields.
    """

    def __init__(
        self, world: World, rows: slice, robot: Robot, settings: MujocoSettings, models: Callable[..., mujoco.MjModel]
    ) -> None:
        super().__init__(world, rows)
        self._robot, self._settings, self._models = robot, settings, models
        self._among: RoversAmongMovers | None = None
        self.measure({})

    def measure(self, reports: Mapping[Force, np.ndarray]) -> None:
        self._reports, model = reports, self._models(self.world, (), frozenset(reports))
        self._physics = RoverPhysics(model, self._robot, len(self.every), self._settings, reports)

    def add_movers(self, parts: Sequence[Part]) -> None:
        slots = slots_of(parts)
        model = self._models(self.world, slots, frozenset(self._reports))
        self.reach = reach_of(model)
        shared = model, self._robot, len(self.every), self._settings, self._reports
        self._among = RoversAmongMovers(*shared, slots, parts)

    def place(self, local: np.ndarray, position: np.ndarray, orientation: np.ndarray) -> None:
        self._physics.place(local, position, orientation)

    def set_dynamics(self, row: int, scales: Sequence[float]) -> None:
        for physics in (self._physics, self._among):
            if physics is not None:
                physics.set_dynamics(row, scales)

    def step(
        self, local: np.ndarray, speeds: np.ndarray, angles: np.ndarray, near: NearParts | None = None
    ) -> np.ndarray:
        physics, among = self._physics, self._among
        if near is None or among is None:
            return physics.step(local, speeds[local], angles[local])
        touched = np.zeros((len(local), 2), dtype=bool)
        beside = np.isin(local, near.row)
        if not beside.all():
            rows = local[~beside]
            touched[~beside, :1] = physics.step(rows, speeds[rows], angles[rows])
        if beside.any():
            rows, near = local[beside], near.chosen(np.flatnonzero(np.isin(near.row, local)))
            states, touched[beside] = among.step_from(physics.states[rows], near, rows, speeds[rows], angles[rows])
            physics.states[rows] = states
        return touched

    def read(self, local: np.ndarray) -> np.ndarray:
        self.position[local], orientation, joints = self._physics.read(local)
        return np.concatenate((self.position[local], np.roll(orientation, -1, axis=1), joints), 1)
