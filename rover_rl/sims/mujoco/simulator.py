"""Simulator of the MuJoCo backend, an implementation of :class:`rover_rl.sims.base.Simulator`."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import groupby

import numpy as np
import torch
from torch import Tensor

from rover_rl.robots import Robot
from rover_rl.robots.fleet import Fleet
from rover_rl.rotations import matrix_to_quaternion
from rover_rl.sims.base import Feature, Simulator, View
from rover_rl.sims.free_space import rest_on_ground
from rover_rl.sims.movers.field import MoverField, shown_parts
from rover_rl.sims.movers.near import NearParts, fastest_point, find_near
from rover_rl.sims.mujoco.lidar import Lidar, Scene
from rover_rl.sims.mujoco.model import make_model
from rover_rl.sims.mujoco.movers import RoversAmongMovers, reach_of
from rover_rl.sims.mujoco.parts import slots_of
from rover_rl.sims.mujoco.physics import RoverPhysics
from rover_rl.sims.mujoco.settings import MujocoSettings
from rover_rl.sims.rendering.cache import RendererCache
from rover_rl.sims.rover_state import Dynamics, Force, RoverState, beam_angles, no_forces, of_rows
from rover_rl.sims.simulated_drives import SimulatedDrives
from rover_rl.worlds import World

MIN_ROVERS_PER_THREAD = 4
"""Minimum number of rovers per thread; with fewer, another thread does not pay."""


class MujocoSimulator(Simulator):
    """Simulator in MuJoCo. Rovers in the same world share a model and do not interact.

    Threads work on shares of the rovers of every world.

    Args:
        worlds: world of each rover. Consecutive rovers in the same world share models.
        robot: robot model.
        settings: settings of the physics. ``None`` uses the defaults.
    """

    features: frozenset[Feature] = frozenset(
        {"contacts", "dynamics", "lidar", "movers", "contact_force", "wheel_torque"}
    )

    def __init__(self, worlds: Sequence[World], robot: Robot, settings: MujocoSettings | None = None) -> None:
        self.num_envs = count = len(worlds)
        self.device = torch.device("cpu")
        self.settings = (settings or MujocoSettings()).for_mass(robot.mass)
        self.control_dt = self.settings.control_dt
        self._robot = robot
        self._worlds = list(worlds)
        self._drive = SimulatedDrives(Fleet.of(robot, count), self.control_dt)
        self._renderers = RendererCache(robot)
        self._reports: dict[Force, np.ndarray] = {}
        threads = self.settings.threads or torch.get_num_threads()
        self._threads = self._divide(min(threads, max(1, count // MIN_ROVERS_PER_THREAD)))
        self._pool = ThreadPoolExecutor(len(self._threads) - 1) if len(self._threads) > 1 else None
        # Position (3), orientation (4) and joints in one array, which is copied at once.
        self._body = np.zeros((count, 7 + len(robot.drive.motors) + len(robot.drive.steering)), dtype=np.float32)
        self._contact, self._mover_contact = np.zeros((2, count, 1), dtype=bool)
        self._movers: MoverField | None = None
        self.reset(torch.ones(count, dtype=torch.bool), torch.zeros(count, 3))

    def _divide(self, threads: int) -> list[list[_Share]]:
        """Returns the shares of each thread: a share of the rovers of every world."""
        shares: list[list[_Share]] = [[] for _ in range(threads)]
        for world, block in groupby(range(self.num_envs), key=self._worlds.__getitem__):
            rows = list(block)
            model = make_model(world, self._robot, self.settings, reports=self._reports)
            ends = np.linspace(rows[0], rows[-1] + 1, threads + 1).astype(int).tolist()
            for own, first, last in zip(shares, ends[:-1], ends[1:], strict=True):
                if last > first:
                    share = slice(first, last)
                    reports = of_rows(self._reports, share)
                    physics = RoverPhysics(model, self._robot, last - first, self.settings, reports)
                    own.append(_Share(world, share, physics))
        return shares

    def measure(self, fields: Collection[Force]) -> None:
        self._reports = no_forces(fields, self.num_envs, len(self._robot.drive.wheels))
        self._threads = self._divide(len(self._threads))

    def add_movers(self, movers: MoverField) -> None:
        self._movers = movers
        shares = [share for shares in self._threads for share in shares]
        for world in dict.fromkeys(share.world for share in shares):
            parts = movers.parts_of(world)
            if not parts:
                continue
            slots = slots_of(parts)
            model = make_model(world, self._robot, self.settings, slots, self._reports)
            reach = reach_of(model)
            for share in (share for share in shares if share.world is world):
                share.reach = reach
                reports = share.physics.reports
                share.pushed = RoversAmongMovers(
                    model, self._robot, len(share.all), self.settings, slots, parts, reports
                )

    def scanner(self, beams: int) -> MujocoScanner:
        scenes = {world: Scene(world, self._robot.lidar_range) for world in dict.fromkeys(self._worlds)}
        angles = beam_angles(beams)
        shares = (share for shares in self._threads for share in shares)
        lidars = {share: Lidar(scenes[share.world], self._robot, angles.numpy()) for share in shares}
        return MujocoScanner(self._run, lidars, np.full((self.num_envs, beams), np.inf, dtype=np.float32))

    def reset(self, mask: Tensor, poses: Tensor) -> RoverState:

        def place(share: _Share, local: np.ndarray) -> None:
            rows = torch.from_numpy(share.rows.start + local)
            position, rotation = rest_on_ground(share.world, self._robot, poses[rows])
            share.physics.place(local, position.numpy(), matrix_to_quaternion(rotation).numpy())
            self._contact[rows.numpy()] = self._mover_contact[rows.numpy()] = False
            for values in self._reports.values():
                values[rows.numpy()] = 0.0

        self._update(place, mask.numpy())
        self._drive.reset(mask)
        return self.state()

    def set_dynamics(self, mask: Tensor, dynamics: Dynamics) -> None:
        factors = torch.stack((dynamics.friction, dynamics.chassis_mass, dynamics.motor_torque), -1).double()
        for share in (share for shares in self._threads for share in shares):
            for row in np.flatnonzero(mask.numpy()[share.rows]).tolist():
                for physics in (share.physics, share.pushed):
                    if physics is not None:
                        physics.set_dynamics(row, factors[share.rows.start + row].tolist())

    def step(self, commands: Tensor, active: Tensor | None = None) -> RoverState:
        speeds, angles = (targets.numpy() for targets in self._drive.advance(commands, active))

        def advance(share: _Share, local: np.ndarray) -> None:
            rows = share.rows.start + local
            if self._movers is None or self._movers.parts is None or share.pushed is None:
                self._contact[rows] = share.physics.step(local, speeds[rows], angles[rows])
                return
            near = find_near(
                self._movers.parts, share.rows, share.position, share.reach, self.control_dt, fastest_point(self._robot)
            )
            touched = share.step_among(near, local, speeds[rows], angles[rows])
            self._contact[rows], self._mover_contact[rows] = touched[:, :1], touched[:, 1:]

        self._update(advance, None if active is None else active.numpy())
        return self.state()

    def state(self) -> RoverState:
        """Returns the current state in new tensors."""
        known = [self._body, self._contact]
        if self._movers is not None and self._movers.parts is not None:
            known.append(self._mover_contact)
        reports = {name: torch.from_numpy(values.copy()) for name, values in self._reports.items()}
        return self._drive.state(*(torch.from_numpy(a.copy()) for a in known), **reports)

    def render(self, row: int, view: View, width: int, height: int, goal: Tensor | None = None) -> Tensor:
        pose, movers = torch.from_numpy(self._body[row, :7]), shown_parts(self._movers, row)
        return self._renderers.render(self._worlds[row], pose, view, width, height, goal, movers)

    def close(self) -> None:
        """Stops the threads and releases the renderers. Idempotent."""
        if self._pool is not None:
            self._pool.shutdown()
        self._renderers.close()

    def _update(self, change: Callable[[_Share, np.ndarray], None], mask: np.ndarray | None) -> None:
        """Changes the rovers of a mask (bool ``[N]``; ``None``: all) and reads their poses and joints.

        ``change`` takes a share and the indices ``[k]`` of the selected rovers within it.
        """

        def update(share: _Share, local: np.ndarray) -> None:
            change(share, local)
            reading = share.physics.read(local)
            rows = share.rows.start + local
            self._body[rows, :3] = share.position[local] = reading.position
            self._body[rows, 3:7] = np.roll(reading.orientation, -1, axis=1)
            self._body[rows, 7:] = reading.joints
            share.orientation[local] = reading.orientation

        self._run(update, mask)

    def _run(self, function: Callable[[_Share, np.ndarray], None], mask: np.ndarray | None) -> None:
        """Calls a function of a share and the indices ``[k]`` of its rovers in the mask, on all threads."""

        def run(shares: list[_Share]) -> None:
            for share in shares:
                local = share.all if mask is None else np.flatnonzero(mask[share.rows])
                if len(local):
                    function(share, local)

        others = [self._pool.submit(run, shares) for shares in self._threads[1:]] if self._pool else []
        run(self._threads[0])
        for other in others:
            other.result()


class MujocoScanner:
    """Lidar on every rover, an implementation of :class:`rover_rl.sims.base.Scanner`."""

    def __init__(self, run: Callable[..., None], lidars: dict[_Share, Lidar], ranges: np.ndarray) -> None:
        self.angles = beam_angles(ranges.shape[1]).float()
        self._run, self._lidars, self._ranges = run, lidars, ranges

    def scan(self, rows: Tensor | None = None) -> Tensor:

        def scan(share: _Share, local: np.ndarray) -> None:
            ranges = self._lidars[share].scan(share.position[local], share.orientation[local])
            self._ranges[share.rows.start + local] = ranges

        self._run(scan, None if rows is None else rows.numpy())
        return torch.from_numpy(self._ranges.copy())


class _Share:
    """Consecutive rovers in the same world that one thread simulates, and their poses."""

    def __init__(self, world: World, rows: slice, physics: RoverPhysics) -> None:
        count = rows.stop - rows.start
        self.world = world
        self.rows = rows
        self.all = np.arange(count)
        self.physics = physics
        self.position = np.zeros((count, 3))
        # Quaternions (w, x, y, z), as MuJoCo has them.
        self.orientation = np.zeros((count, 4))
        # Physics of the rovers near movers, and radius of a sphere around the base frame that contains a rover, m.
        self.pushed: RoversAmongMovers | None = None
        self.reach = 0.0

    def step_among(self, near: NearParts, local: np.ndarray, speeds: np.ndarray, angles: np.ndarray) -> np.ndarray:
        """Advances the rovers ``local [k]``, those near movers among these.

        Returns which of them touched an obstacle or a mover, and which a mover, bool ``[k, 2]``.
        """
        assert self.pushed is not None
        touched = np.zeros((len(local), 2), dtype=bool)
        beside = np.isin(local, near.row)
        if not beside.all():
            touched[~beside, :1] = self.physics.step(local[~beside], speeds[~beside], angles[~beside])
        if beside.any():
            rows, near = local[beside], near.chosen(np.flatnonzero(np.isin(near.row, local)))
            states = self.physics.states(rows)
            states, touched[beside] = self.pushed.step_from(states, near, rows, speeds[beside], angles[beside])
            self.physics.set_states(rows, states)
        return touched
