"""Bullet backend: batched rovers in one or several worlds."""

from __future__ import annotations

import math
import weakref
from collections.abc import Sequence
from itertools import groupby

import numpy as np
import torch
from torch import Tensor

from rover_rl.sims.base import Capability, Dynamics, RoverState, View
from rover_rl.sims.bullet.lidar import Lidar
from rover_rl.sims.bullet.physics import RoverPhysics
from rover_rl.sims.bullet.settings import BulletSettings
from rover_rl.sims.drives.simulated import SimulatedDrives
from rover_rl.sims.free_space import rest_on_ground
from rover_rl.sims.native.bullet import disconnect
from rover_rl.sims.rendering.cache import RendererCache
from rover_rl.sims.robots import Robot
from rover_rl.sims.rotations import matrix_to_quaternion
from rover_rl.sims.worlds import World


class BulletSimulator:
    """Simulator in PyBullet. Each world has separate Bullet clients for the physics and the lidar.

    Args:
        worlds: world of each rover. Consecutive rovers in the same world share clients and do not interact.
        robot: robot model.
        lidar_beams: number of beams of a scan, evenly spaced counter-clockwise over the full turn, the first forward.
        settings: settings of the physics. ``None`` uses the defaults.
    """

    capabilities: frozenset[Capability] = frozenset({"contacts", "dynamics", "scan_period"})

    def __init__(
        self, worlds: Sequence[World], robot: Robot, lidar_beams: int, settings: BulletSettings | None = None
    ) -> None:
        self.num_envs = len(worlds)
        self.device = torch.device("cpu")
        self.ray_angles = torch.arange(lidar_beams, dtype=torch.float32) * (2 * math.pi / lidar_beams)
        self.settings = settings or BulletSettings()
        self.control_dt = self.settings.control_dt
        self._robot = robot
        self._drive = SimulatedDrives(robot.drive, robot.wheels, self.control_dt, self.num_envs)
        self._renderers = RendererCache(robot)
        self._clients: list[int] = []
        self._finalizer = weakref.finalize(self, disconnect, self._clients)
        angles = np.arange(lidar_beams) * (2 * math.pi / lidar_beams)
        self._groups: list[_WorldGroup] = []
        for world, block in groupby(range(self.num_envs), key=worlds.__getitem__):
            rows = np.array(list(block))
            physics = RoverPhysics(world, robot, len(rows), self.settings)
            self._clients.extend(physics.clients)
            lidar = Lidar(world, robot, angles)
            self._clients.append(lidar.client)
            self._groups.append(_WorldGroup(world, rows, physics, lidar))

        count = self.num_envs
        # Position (3), orientation (4) and joints in one array, which is copied at once.
        self._body = np.zeros((count, 7 + len(robot.drive.motors) + len(robot.drive.steering)), dtype=np.float32)
        self._ranges = np.full((count, lidar_beams), np.inf, dtype=np.float32)
        self._contact = np.zeros((count, 1), dtype=bool)
        self.reset(torch.ones(count, dtype=torch.bool), torch.zeros(count, 3))

    def reset(self, mask: Tensor, poses: Tensor) -> RoverState:
        """Places the selected rovers on the ground, at rest. See :meth:`Simulator.reset`."""
        for group in self._groups:
            local = np.flatnonzero(mask.numpy()[group.rows])
            if not len(local):
                continue
            rows = group.rows[local]
            position, rotation = rest_on_ground(group.world, self._robot, poses[torch.from_numpy(rows)])
            group.physics.place(local.tolist(), position.numpy(), matrix_to_quaternion(rotation).numpy())
            self._read(group, local)
            self._contact[rows] = False
        self._drive.reset(mask)
        return self.state()

    def set_dynamics(self, mask: Tensor, dynamics: Dynamics) -> None:
        """Sets the dynamics of the selected rovers. See :meth:`Simulator.set_dynamics`."""
        factors = torch.stack((dynamics.friction, dynamics.chassis_mass, dynamics.motor_torque), -1).double()
        for group in self._groups:
            local = np.flatnonzero(mask.numpy()[group.rows])
            for row, scales in zip(local.tolist(), factors[torch.from_numpy(group.rows[local])].tolist(), strict=True):
                group.physics.set_dynamics(row, *scales)

    def step(self, commands: Tensor, active: Tensor | None = None, scanned: Tensor | None = None) -> RoverState:
        """Advances the rovers by one control step of ``substeps`` physics steps. See :meth:`Simulator.step`."""
        speeds, angles = (targets.tolist() for targets in self._drive.advance(commands, active))
        for group in self._groups:
            held = [] if active is None else np.flatnonzero(~active.numpy()[group.rows]).tolist()
            touched = group.physics.step(speeds[group.block], angles[group.block], self._body[group.block, :7], held)
            local = group.local if not held else np.setdiff1d(group.local, held)
            self._read(group, local, None if scanned is None else scanned.numpy())
            self._contact[group.rows[local], 0] = touched[local]
        return self.state()

    def state(self) -> RoverState:
        """Returns the current state in new tensors."""
        return self._drive.state(*(torch.from_numpy(a.copy()) for a in (self._body, self._ranges, self._contact)))

    def render(self, row: int, view: View, width: int, height: int, goal: Tensor | None = None) -> Tensor:
        """Renders one rover. See :meth:`Simulator.render`."""
        world = next(group.world for group in self._groups if row in group.rows)
        return self._renderers.render(world, torch.from_numpy(self._body[row, :7]), view, width, height, goal)

    @property
    def robot_connected(self) -> bool:
        """Whether the rovers are connected. Always true in simulation."""
        return True

    def close(self) -> None:
        """Disconnects all Bullet clients. Idempotent."""
        self._finalizer()
        self._renderers.close()

    def _read(self, group: _WorldGroup, local: np.ndarray, scanned: np.ndarray | None = None) -> None:
        """Reads the poses and joints of rovers and updates their scans.

        Args:
            group: group of the rovers.
            local: indices of the rovers within the group.
            scanned: rovers of the batch that scan, bool ``[N]``; ``None``: all.
        """
        if not len(local):
            return
        reading = group.physics.read(local.tolist())
        rows = group.block if len(local) == len(group.local) else group.rows[local]
        self._body[rows, :3] = reading.position
        self._body[rows, 3:7] = reading.orientation
        self._body[rows, 7:] = reading.joints
        if scanned is None:
            self._ranges[rows] = group.lidar.scan(reading.position, reading.rotation)
        elif len(chosen := np.flatnonzero(scanned[group.rows[local]])):
            ranges = group.lidar.scan(reading.position[chosen], reading.rotation[chosen])
            self._ranges[group.rows[local[chosen]]] = ranges


class _WorldGroup:
    """Consecutive rows of the batch that are in the same world, with their physics and lidar."""

    def __init__(self, world: World, rows: np.ndarray, physics: RoverPhysics, lidar: Lidar) -> None:
        self.world = world
        self.rows = rows
        self.block = slice(int(rows[0]), int(rows[-1]) + 1)
        self.local = np.arange(len(rows))
        self.physics = physics
        self.lidar = lidar
