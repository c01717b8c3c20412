"""Bullet backend: batched rovers in one or several worlds."""

from __future__ import annotations

import weakref
from collections.abc import Collection, Sequence
from itertools import groupby

import numpy as np
import torch
from torch import Tensor

from rover_rl.native.bullet import disconnect
from rover_rl.robots import Robot
from rover_rl.robots.fleet import Fleet
from rover_rl.rotations import matrix_to_quaternion
from rover_rl.sims.base import Feature, Simulator, View
from rover_rl.sims.bullet.lidar import Lidar
from rover_rl.sims.bullet.physics import RoverPhysics
from rover_rl.sims.bullet.settings import BulletSettings
from rover_rl.sims.free_space import rest_on_ground
from rover_rl.sims.movers.field import MoverField, shown_parts
from rover_rl.sims.movers.near import NearParts, fastest_point, find_near
from rover_rl.sims.rendering.cache import RendererCache
from rover_rl.sims.rover_state import Dynamics, Force, RoverState, beam_angles, no_forces, of_rows
from rover_rl.sims.simulated_drives import SimulatedDrives
from rover_rl.worlds import World


class BulletSimulator(Simulator):
    """Simulator in PyBullet. Each world has separate Bullet clients for the physics and the lidar.

    Args:
        worlds: world of each rover. Consecutive rovers in the same world share clients and do not interact.
        robot: robot model.
        settings: settings of the physics. ``None`` uses the defaults.
    """

    features: frozenset[Feature] = frozenset(
        {"contacts", "dynamics", "lidar", "movers", "contact_force", "wheel_torque"}
    )

    def __init__(self, worlds: Sequence[World], robot: Robot, settings: BulletSettings | None = None) -> None:
        self.num_envs = len(worlds)
        self.device = torch.device("cpu")
        self.settings = (settings or BulletSettings()).for_mass(robot.mass)
        self.control_dt = self.settings.control_dt
        self._robot = robot
        self._drive = SimulatedDrives(Fleet.of(robot, self.num_envs), self.control_dt)
        self._renderers = RendererCache(robot)
        self._clients: list[int] = []
        self._finalizer = weakref.finalize(self, disconnect, self._clients)
        self._groups: list[_WorldGroup] = []
        for world, block in groupby(range(self.num_envs), key=worlds.__getitem__):
            rows = np.array(list(block))
            physics = RoverPhysics(world, robot, len(rows), self.settings)
            self._clients.extend(physics.clients)
            self._groups.append(_WorldGroup(world, rows, physics))

        count = self.num_envs
        # Position (3), orientation (4) and joints in one array, which is copied at once.
        self._body = np.zeros((count, 7 + len(robot.drive.motors) + len(robot.drive.steering)), dtype=np.float32)
        self._contact, self._mover_contact = np.zeros((2, count, 1), dtype=bool)
        self._reports: dict[Force, np.ndarray] = {}
        self._movers: MoverField | None = None
        self.reset(torch.ones(count, dtype=torch.bool), torch.zeros(count, 3))

    def reset(self, mask: Tensor, poses: Tensor) -> RoverState:
        for group in self._groups:
            local = np.flatnonzero(mask.numpy()[group.rows])
            if not len(local):
                continue
            rows = group.rows[local]
            position, rotation = rest_on_ground(group.world, self._robot, poses[torch.from_numpy(rows)])
            group.physics.place(local.tolist(), position.numpy(), matrix_to_quaternion(rotation).numpy())
            self._read(group, local)
            self._contact[rows] = self._mover_contact[rows] = False
            for values in self._reports.values():
                values[rows] = 0.0
        self._drive.reset(mask)
        return self.state()

    def set_dynamics(self, mask: Tensor, dynamics: Dynamics) -> None:
        factors = torch.stack((dynamics.friction, dynamics.chassis_mass, dynamics.motor_torque), -1).double()
        for group in self._groups:
            local = np.flatnonzero(mask.numpy()[group.rows])
            for row, scales in zip(local.tolist(), factors[torch.from_numpy(group.rows[local])].tolist(), strict=True):
                group.physics.set_dynamics(row, *scales)

    def measure(self, fields: Collection[Force]) -> None:
        self._reports = no_forces(fields, self.num_envs, len(self._robot.drive.wheels))
        for group in self._groups:
            group.physics.report(of_rows(self._reports, group.block))

    def add_movers(self, movers: MoverField) -> None:
        self._movers = movers
        for group in self._groups:
            group.physics.meet(movers.parts_of(group.world))

    def scanner(self, beams: int) -> BulletScanner:
        lidars = [Lidar(group.world, self._robot, beam_angles(beams).numpy()) for group in self._groups]
        self._clients.extend(lidar.client for lidar in lidars)
        return BulletScanner(self._groups, lidars, beams)

    def step(self, commands: Tensor, active: Tensor | None = None) -> RoverState:
        speeds, angles = (targets.tolist() for targets in self._drive.advance(commands, active))
        for group in self._groups:
            held = [] if active is None else np.flatnonzero(~active.numpy()[group.rows]).tolist()
            poses, near = self._body[group.block, :7], self._near(group)
            touched, pushed = group.physics.step(speeds[group.block], angles[group.block], poses, held, near)
            local = group.local if not held else np.setdiff1d(group.local, held)
            self._read(group, local)
            self._contact[group.rows[local], 0] = touched[local]
            self._mover_contact[group.rows[local], 0] = pushed[local]
        return self.state()

    def state(self) -> RoverState:
        """Returns the current state in new tensors."""
        known = [self._body, self._contact]
        if self._movers is not None and self._movers.parts is not None:
            known.append(self._mover_contact)
        reports = {name: torch.from_numpy(values.copy()) for name, values in self._reports.items()}
        return self._drive.state(*(torch.from_numpy(a.copy()) for a in known), **reports)

    def render(self, row: int, view: View, width: int, height: int, goal: Tensor | None = None) -> Tensor:
        world = next(group.world for group in self._groups if row in group.rows)
        pose, movers = torch.from_numpy(self._body[row, :7]), shown_parts(self._movers, row)
        return self._renderers.render(world, pose, view, width, height, goal, movers)

    def close(self) -> None:
        """Disconnects all Bullet clients. Idempotent."""
        self._finalizer()
        self._renderers.close()

    def _near(self, group: _WorldGroup) -> NearParts | None:
        """Returns the parts of movers near the rovers of a group."""
        if self._movers is None or self._movers.parts is None:
            return None
        speed = fastest_point(self._robot)
        return find_near(self._movers.parts, group.block, group.position, group.physics.reach, self.control_dt, speed)

    def _read(self, group: _WorldGroup, local: np.ndarray) -> None:
        """Reads the poses and joints of the rovers with indices ``local`` within their group."""
        if not len(local):
            return
        reading = group.physics.read(local.tolist())
        rows = group.block if len(local) == len(group.local) else group.rows[local]
        self._body[rows, :3] = group.position[local] = reading.position
        self._body[rows, 3:7] = reading.orientation
        self._body[rows, 7:] = reading.joints
        group.rotation[local] = reading.rotation


class BulletScanner:
    """Lidar on every rover, an implementation of :class:`rover_rl.sims.base.Scanner`."""

    def __init__(self, groups: list[_WorldGroup], lidars: list[Lidar], beams: int) -> None:
        self.angles = beam_angles(beams).float()
        self._groups, self._lidars = groups, lidars
        self._ranges = np.full((sum(len(group.rows) for group in groups), beams), np.inf, dtype=np.float32)

    def scan(self, rows: Tensor | None = None) -> Tensor:
        for group, lidar in zip(self._groups, self._lidars, strict=True):
            local = group.local if rows is None else np.flatnonzero(rows.numpy()[group.rows])
            if len(local):
                self._ranges[group.rows[local]] = lidar.scan(group.position[local], group.rotation[local])
        return torch.from_numpy(self._ranges.copy())


class _WorldGroup:
    """Consecutive rows of the batch that are in the same world, their physics and their poses."""

    def __init__(self, world: World, rows: np.ndarray, physics: RoverPhysics) -> None:
        self.world = world
        self.rows = rows
        self.block = slice(int(rows[0]), int(rows[-1]) + 1)
        self.local = np.arange(len(rows))
        self.physics = physics
        self.position = np.zeros((len(rows), 3))
        self.rotation = np.zeros((len(rows), 3, 3))
