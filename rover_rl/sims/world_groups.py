"""Base of simulators that keep the rovers of a world together, as Bullet and MuJoCo do, and the movers near them."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields
from itertools import groupby, pairwise
from typing import Any, TypeAlias

import numpy as np
import torch
from torch import Tensor

from rover_rl.robots import Robot
from rover_rl.robots.fleet import Fleet
from rover_rl.rotations import matrix_to_quaternion
from rover_rl.sims.base import Feature, Simulator, View
from rover_rl.sims.free_space import rest_on_ground
from rover_rl.sims.movers.field import MoverField, shown_parts
from rover_rl.sims.rendering.cache import RendererCache
from rover_rl.sims.rover_state import Dynamics, Force, RoverState, SimulatedDrives, no_forces
from rover_rl.worlds import World
from rover_rl.worlds.movers import Part
from rover_rl.worlds.movers.parts import Parts

MAX_ROVER_SPEED = 2.0
"""Least speed above which a point of a rover may reach something unnoticed within a control step, m/s."""


def fastest_point(robot: Robot) -> float:
    """Twice the robot's own speed, as a corner of a robot that turns is faster than its middle, m/s."""
    return max(MAX_ROVER_SPEED, 2 * robot.drive.max_speed)


@dataclass(frozen=True)
class NearParts:
    """Parts of movers near the rovers of consecutive rows, by row and nearest first. Float64.

    Attributes:
        row: index of the row within these rows, int ``[K]``.
        part: index of the part within its row, int ``[K]``.
        start: center at the start of the control step, ``[K, 3]``, m.
        orientation: orientation then, unit quaternion (x, y, z, w), ``[K, 4]``.
        velocity: velocity in the step, ``[K, 3]``, m/s.
        turn: yaw rate in the step, ``[K]``, rad/s.
    """

    row: np.ndarray
    part: np.ndarray
    start: np.ndarray
    orientation: np.ndarray
    velocity: np.ndarray
    turn: np.ndarray

    def chosen(self, index: np.ndarray) -> NearParts:
        """Returns the parts at indices ``[k]``."""
        return NearParts(*(getattr(self, item.name)[index] for item in fields(self)))


def find_near(
    parts: Parts, rows: slice, position: np.ndarray, reach: float, dt: float, speed: float = MAX_ROVER_SPEED
) -> NearParts:
    """Returns the parts of movers near rovers in a step of ``dt`` (s), at whose end the parts are.

    The rovers are in consecutive ``rows`` and were at ``position [n, 3]`` (m) at its start. ``reach`` (m) is the radius
    of a sphere around that contains one, and ``speed`` (m/s) the highest one of its points.
    """
    end, velocity, half = (getattr(parts, name)[rows].double().numpy() for name in ("position", "velocity", "half"))
    start = end - velocity * dt
    gap = np.sqrt(((start - position[:, None]) ** 2).sum(-1)) - np.sqrt((half**2).sum(-1))
    limit = reach + (np.sqrt((velocity**2).sum(-1)) + speed) * dt
    row, part = np.nonzero((parts.kind[rows].numpy() >= 0) & (gap < limit))
    order = np.lexsort((part, gap[row, part], row))
    row, part = row[order], part[order]
    turn = parts.turn[rows].double().numpy()[row, part]
    orientation = parts.orientation[rows].double().numpy()[row, part]
    return NearParts(row, part, start[row, part], turned(orientation, -turn * dt), velocity[row, part], turn)


def turned(orientation: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Turns orientations (x, y, z, w) ``[K, 4]`` by angles about the vertical ``[K]``, rad."""
    sin, cos = np.sin(angle / 2), np.cos(angle / 2)
    x, y, z, w = orientation.T
    return np.stack((cos * x - sin * y, cos * y + sin * x, cos * z + sin * w, cos * w - sin * z), -1)


class WorldGroup:
    """Consecutive rovers of a batch in the same world, and their physics. They do not interact.

    Methods take rovers by their indices within the group, ``local [k]``.

    Attributes:
        world: world of the rovers.
        rows: rows of the batch.
        every: indices of all rovers of the group.
        position: positions of the base frames, float64 ``[count, 3]``, m.
        orientation: orientations of the base frames as a lidar of the simulator takes them, ``[count, ...]``.
        reach: radius of a sphere around a base frame that contains the rover, m.
        meets_movers: whether the world has movers.
    """

    orientation: np.ndarray
    reach: float
    meets_movers = False

    def __init__(self, world: World, rows: slice) -> None:
        self.world, self.rows = world, rows
        self.every = np.arange(rows.stop - rows.start)
        self.position = np.zeros((len(self.every), 3))

    def place(self, local: np.ndarray, position: np.ndarray, orientation: np.ndarray) -> None:
        """Places base frames at positions ``[k, 3]`` (m) and orientations (x, y, z, w) ``[k, 4]``, at rest."""
        raise NotImplementedError

    def set_dynamics(self, row: int, scales: Sequence[float]) -> None:
        """Scales friction, chassis mass and motor torque of one rover: see :class:`~rover_rl.sims.base.Dynamics`."""
        raise NotImplementedError

    def measure(self, reports: Mapping[Force, np.ndarray]) -> None:
        """Writes the fields ``[count, k]`` in each control step from now on."""
        raise NotImplementedError

    def add_movers(self, parts: Sequence[Part]) -> None:
        """Lets parts of movers push the rovers."""
        raise NotImplementedError

    def step(
        self, local: np.ndarray, speeds: np.ndarray, angles: np.ndarray, near: NearParts | None = None
    ) -> np.ndarray:
        """Advances rovers by one control step.

        ``speeds`` of each motor are ``[count, M]``, rad/s, ``angles`` of each steering joint ``[count, S]``, rad, of
        all rovers of the group, and ``near`` are the parts of movers near these. Returns which of ``local`` touched an
        obstacle or a mover in any of the physics steps, and, with movers, which touched one: bool ``[k, 1 or 2]``.
        """
        raise NotImplementedError

    def read(self, local: np.ndarray) -> np.ndarray:
        """Updates ``position``, and returns poses and joints, float64 ``[k, 7 + M + S]``.

        These are position (m) and orientation (x, y, z, w) of the base frames, mean speed of the wheels of each motor
        (rad/s) and angle of each steering joint (rad).
        """
        raise NotImplementedError


Change: TypeAlias = Callable[[WorldGroup, np.ndarray, Any], None]
"""Function of a group, of rovers within it, and of their rows in the batch (a slice or indices)."""


class GroupedSimulator(Simulator):
    """Base of simulators on the CPU that keep consecutive rovers in the same world together.

    ``worlds`` holds the world of each rover. Without ``settings``, the physics of a simulator has its defaults. Each
    simulator has :meth:`_group`. Each of the threads works on a share of the rovers of every world.
    """

    features: frozenset[Feature] = frozenset({"contacts", "dynamics", "movers", "contact_force", "wheel_torque"})

    def __init__(self, worlds: Sequence[World], robot: Robot, settings: Any, threads: int = 1) -> None:
        self.num_envs = count = len(worlds)
        self.device = torch.device("cpu")
        self.settings = settings.for_mass(robot.mass)
        self.control_dt: float = self.settings.control_dt
        self._robot, self._worlds, self._fastest = robot, list(worlds), fastest_point(robot)
        self._drive = SimulatedDrives(Fleet.of(robot, count), self.control_dt)
        self._renderers = RendererCache(robot)
        # Position (3), orientation (4) and joints in one array, which is copied at once.
        self._body = np.zeros((count, 7 + len(robot.drive.motors) + len(robot.drive.steering)), dtype=np.float32)
        # Whether each rover touched an obstacle or a mover, and whether it touched a mover.
        self._touched = np.zeros((count, 2), dtype=bool)
        self._reports: dict[Force, np.ndarray] = {}
        self._movers: MoverField | None = None
        self._shares: list[list[WorldGroup]] = [[] for _ in range(threads)]
        for world, block in groupby(range(count), key=self._worlds.__getitem__):
            rows = list(block)
            ends = np.linspace(rows[0], rows[-1] + 1, threads + 1).astype(int).tolist()
            for share, (first, last) in zip(self._shares, pairwise(ends), strict=True):
                if last > first:
                    share.append(self._group(world, slice(first, last)))
        self._groups = [group for share in self._shares for group in share]
        self._pool = ThreadPoolExecutor(threads - 1) if threads > 1 else None
        self.reset(torch.ones(count, dtype=torch.bool), torch.zeros(count, 3))

    def _group(self, world: World, rows: slice) -> WorldGroup:
        raise NotImplementedError

    def reset(self, mask: Tensor, poses: Tensor) -> RoverState:

        def place(group: WorldGroup, local: np.ndarray, rows: Any) -> None:
            position, rotation = rest_on_ground(group.world, self._robot, poses[rows])
            group.place(local, position.numpy(), matrix_to_quaternion(rotation).numpy())
            self._body[rows] = group.read(local)
            self._touched[rows] = False
            for values in self._reports.values():
                values[rows] = 0.0

        self._each(place, mask.numpy())
        self._drive.reset(mask)
        return self.state()

    def set_dynamics(self, mask: Tensor, dynamics: Dynamics) -> None:
        factors = torch.stack((dynamics.friction, dynamics.chassis_mass, dynamics.motor_torque), -1).double()
        for group in self._groups:
            for row in np.flatnonzero(mask.numpy()[group.rows]).tolist():
                group.set_dynamics(row, factors[group.rows.start + row].tolist())

    def measure(self, fields: Collection[Force]) -> None:
        self._reports = no_forces(fields, self.num_envs, len(self._robot.drive.wheels))
        for group in self._groups:
            group.measure({field: values[group.rows] for field, values in self._reports.items()})

    def add_movers(self, movers: MoverField) -> None:
        self._movers = movers
        for group in self._groups:
            if parts := movers.parts_of(group.world):
                group.meets_movers = True
                group.add_movers(parts)

    def step(self, commands: Tensor, active: Tensor | None = None) -> RoverState:
        speeds, angles = (targets.numpy() for targets in self._drive.advance(commands, active))
        parts, dt = None if self._movers is None else self._movers.parts, self.control_dt

        def advance(group: WorldGroup, local: np.ndarray, rows: Any) -> None:
            near = None
            if parts is not None and group.meets_movers:
                near = find_near(parts, group.rows, group.position, group.reach, dt, self._fastest)
            touched = group.step(local, speeds[group.rows], angles[group.rows], near)
            self._touched[rows, : touched.shape[1]] = touched
            self._body[rows] = group.read(local)

        self._each(advance, None if active is None else active.numpy())
        return self.state()

    def state(self) -> RoverState:
        """Returns the current state in new tensors."""
        known = [self._body.copy(), self._touched[:, :1].copy()]
        if self._movers is not None and self._movers.parts is not None:
            known.append(self._touched[:, 1:].copy())
        reports = {name: torch.from_numpy(values.copy()) for name, values in self._reports.items()}
        return self._drive.state(*map(torch.from_numpy, known), **reports)

    def render(self, row: int, view: View, width: int, height: int, goal: Tensor | None = None) -> Tensor:
        pose, movers = torch.from_numpy(self._body[row, :7]), shown_parts(self._movers, row)
        return self._renderers.render(self._worlds[row], pose, view, width, height, goal, movers)

    def close(self) -> None:
        if self._pool is not None:
            self._pool.shutdown()
        self._renderers.close()

    def _each(self, change: Change, mask: np.ndarray | None) -> None:
        """Calls a function for the rovers of a mask (bool ``[N]``; ``None``: all) of each group, on all threads."""

        def run(groups: list[WorldGroup]) -> None:
            for group in groups:
                if mask is None:
                    change(group, group.every, group.rows)
                elif len(local := np.flatnonzero(mask[group.rows])):
                    change(group, local, group.rows.start + local)

        others = [self._pool.submit(run, groups) for groups in self._shares[1:]] if self._pool else []
        run(self._shares[0])
        for other in others:
            other.result()
