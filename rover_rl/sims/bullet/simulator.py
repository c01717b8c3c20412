"""The Bullet backend: batched rovers in one or several worlds behind the :class:`Simulator` seam."""

from __future__ import annotations

import math
import weakref
from collections.abc import Sequence
from itertools import groupby

import numpy as np
import torch
from torch import Tensor

from rover_rl.sims.base import Dynamics, RoverState, View
from rover_rl.sims.bullet.lidar import Lidar
from rover_rl.sims.bullet.physics import RoverPhysics
from rover_rl.sims.bullet.settings import BulletSettings
from rover_rl.sims.differential_drive import SimulatedDrive
from rover_rl.sims.native.bullet import disconnect
from rover_rl.sims.rendering.renderer import Renderer
from rover_rl.sims.robots import Robot
from rover_rl.sims.rotations import matrix_to_quaternion
from rover_rl.sims.worlds import World, rest_on_ground


class BulletSimulator:
    """Rovers in PyBullet: one pair of clients a world, one for the physics of its rovers and one for their lidar rays.

    Args:
        worlds: the world of each rover. Neighbours in the same world share its clients, and do not notice.
        robot: the rover.
        lidar_beams: beams of a scan, spread evenly over the full turn from straight ahead counter-clockwise.
        settings: of the physics.
    """

    def __init__(
        self,
        worlds: Sequence[World],
        robot: Robot,
        lidar_beams: int,
        settings: BulletSettings | None = None,
    ) -> None:
        self.num_envs = len(worlds)
        self.device = torch.device("cpu")
        self.ray_angles = torch.arange(lidar_beams, dtype=torch.float32) * (2 * math.pi / lidar_beams)
        self.settings = settings or BulletSettings()
        self.control_dt = self.settings.control_dt
        self._robot = robot
        self._drive = SimulatedDrive(robot, self.control_dt, self.num_envs)
        self._renderers: dict[int, Renderer] = {}
        self._clients: list[int] = []
        self._finalizer = weakref.finalize(self, disconnect, self._clients)
        angles = np.arange(lidar_beams) * (2 * math.pi / lidar_beams)
        self._places: list[_Place] = []
        for world, block in groupby(range(self.num_envs), key=worlds.__getitem__):
            rows = np.array(list(block))
            physics = RoverPhysics(world, robot, len(rows), self.settings)
            self._clients.extend(physics.clients)
            lidar = Lidar(world, robot, angles)
            self._clients.append(lidar.client)
            self._places.append(_Place(world, rows, physics, lidar))

        count = self.num_envs
        # Position (3), orientation (4) and wheel speeds (2) side by side, to be handed out at once.
        self._body = np.zeros((count, 9), dtype=np.float32)
        self._ranges = np.full((count, lidar_beams), np.inf, dtype=np.float32)
        self.reset(torch.ones(count, dtype=torch.bool), torch.zeros(count, 3))

    def reset(self, mask: Tensor, poses: Tensor) -> RoverState:
        """Puts the rovers of ``mask`` on the ground at ``poses``: see :meth:`Simulator.reset`."""
        for place in self._places:
            local = np.flatnonzero(mask.numpy()[place.rows])
            if not len(local):
                continue
            rows = place.rows[local]
            position, rotation = rest_on_ground(place.world, self._robot, poses[torch.from_numpy(rows)])
            place.physics.place(local.tolist(), position.numpy(), matrix_to_quaternion(rotation).numpy())
            self._read(place, local)
        self._drive.reset(mask)
        return self.state()

    def set_dynamics(self, mask: Tensor, dynamics: Dynamics) -> None:
        """Gives the rovers of ``mask`` these dynamics: see :meth:`Simulator.set_dynamics`."""
        factors = torch.stack((dynamics.friction, dynamics.chassis_mass, dynamics.motor_torque), -1).double()
        for place in self._places:
            local = np.flatnonzero(mask.numpy()[place.rows])
            for row, varied in zip(local.tolist(), factors[torch.from_numpy(place.rows[local])].tolist(), strict=True):
                place.physics.set_dynamics(row, *varied)

    def step(self, commands: Tensor, active: Tensor | None = None) -> RoverState:
        """Drives one control step of ``substeps`` physics steps: see :meth:`Simulator.step`."""
        speeds = self._drive.advance(commands, active).tolist()
        for place in self._places:
            held = [] if active is None else np.flatnonzero(~active.numpy()[place.rows]).tolist()
            place.physics.step(speeds[place.block], held)
            self._read(place, place.all if not held else np.setdiff1d(place.all, held))
        return self.state()

    def state(self) -> RoverState:
        """The present state, in tensors of its own."""
        return self._drive.state(torch.from_numpy(self._body.copy()), torch.from_numpy(self._ranges.copy()))

    def render(self, row: int, view: View, width: int, height: int, goal: Tensor | None = None) -> Tensor:
        """A picture by Bullet's own software renderer: see :meth:`Simulator.render`."""
        index = next(k for k, place in enumerate(self._places) if row in place.rows)
        if index not in self._renderers:
            self._renderers[index] = Renderer(self._places[index].world, self._robot)
        pose = self._body[row].astype(float)
        return self._renderers[index].picture(
            pose[:3], pose[3:7], view, width, height, None if goal is None else goal.tolist()
        )

    @property
    def robot_connected(self) -> bool:
        """Always."""
        return True

    def close(self) -> None:
        """Disconnects every client; may be called again."""
        self._finalizer()
        for renderer in self._renderers.values():
            renderer.close()
        self._renderers.clear()

    def _read(self, place: _Place, local: np.ndarray) -> None:
        """Reads rovers of one place and scans for them; ``local`` counts within the place."""
        if not len(local):
            return
        reading = place.physics.read(local.tolist())
        rows = place.block if len(local) == len(place.all) else place.rows[local]
        self._body[rows, :3] = reading.position
        self._body[rows, 3:7] = reading.orientation
        self._body[rows, 7:] = reading.wheel_speeds
        self._ranges[rows] = place.lidar.scan(reading.position, reading.rotation)


class _Place:
    """One world with its clients, and the rows of the batch that are in it: a block of neighbours."""

    def __init__(self, world: World, rows: np.ndarray, physics: RoverPhysics, lidar: Lidar) -> None:
        self.world = world
        self.rows = rows
        self.block = slice(int(rows[0]), int(rows[-1]) + 1)
        self.all = np.arange(len(rows))
        self.physics = physics
        self.lidar = lidar
