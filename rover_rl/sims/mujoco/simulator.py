"""Simulator of the MuJoCo backend, an implementation of :class:`rover_rl.sims.base.Simulator`."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import groupby

import numpy as np
import torch
from torch import Tensor

from rover_rl.sims.base import Capability, Dynamics, RoverState, View
from rover_rl.sims.drives.simulated import SimulatedDrives
from rover_rl.sims.free_space import rest_on_ground
from rover_rl.sims.mujoco.lidar import Lidar, Scene
from rover_rl.sims.mujoco.model import make_model
from rover_rl.sims.mujoco.physics import RoverPhysics
from rover_rl.sims.mujoco.settings import MujocoSettings
from rover_rl.sims.rendering.cache import RendererCache
from rover_rl.sims.robots import Robot
from rover_rl.sims.robots.inertial_model import read_inertial_model
from rover_rl.sims.rotations import matrix_to_quaternion
from rover_rl.sims.worlds import World

MIN_ROVERS_PER_THREAD = 4
"""Minimum number of rovers per thread; with fewer, another thread does not pay."""


class MujocoSimulator:
    """Simulator in MuJoCo. Rovers in the same world share a model and do not interact.

    Threads work on shares of the rovers of every world: each steps the physics of its rovers and then scans.

    Args:
        worlds: world of each rover. Consecutive rovers in the same world share models.
        robot: robot model.
        lidar_beams: number of beams of a scan, evenly spaced counter-clockwise over the full turn, the first forward.
        settings: settings of the physics. ``None`` uses the defaults.

    Raises:
        ValueError: for a robot whose URDF is not supported: see
            :func:`rover_rl.sims.robots.inertial_model.read_inertial_model`.
    """

    capabilities: frozenset[Capability] = frozenset({"contacts", "dynamics", "scan_period"})

    def __init__(
        self, worlds: Sequence[World], robot: Robot, lidar_beams: int, settings: MujocoSettings | None = None
    ) -> None:
        self.num_envs = count = len(worlds)
        self.device = torch.device("cpu")
        self.ray_angles = torch.arange(lidar_beams, dtype=torch.float32) * (2 * math.pi / lidar_beams)
        self.settings = settings or MujocoSettings()
        self.control_dt = self.settings.control_dt
        self._robot = robot
        self._worlds = list(worlds)
        self._drive = SimulatedDrives(robot.drive, robot.wheels, self.control_dt, count)
        self._renderers = RendererCache(robot)
        threads = self.settings.threads or torch.get_num_threads()
        self._threads = self._divide(min(threads, max(1, count // MIN_ROVERS_PER_THREAD)), lidar_beams)
        self._pool = ThreadPoolExecutor(len(self._threads) - 1) if len(self._threads) > 1 else None
        # Position (3), orientation (4) and joints in one array, which is copied at once.
        self._body = np.zeros((count, 7 + len(robot.drive.motors) + len(robot.drive.steering)), dtype=np.float32)
        self._ranges = np.full((count, lidar_beams), np.inf, dtype=np.float32)
        self._contact = np.zeros((count, 1), dtype=bool)
        self.reset(torch.ones(count, dtype=torch.bool), torch.zeros(count, 3))

    def _divide(self, threads: int, beams: int) -> list[list[_Share]]:
        """Returns the shares of each thread: a share of the rovers of every world."""
        inertial_model = read_inertial_model(self._robot)
        angles = np.arange(beams) * (2 * math.pi / beams)
        shares: list[list[_Share]] = [[] for _ in range(threads)]
        for world, block in groupby(range(self.num_envs), key=self._worlds.__getitem__):
            rows = list(block)
            model, scene = make_model(world, self._robot, inertial_model, self.settings), Scene(world)
            ends = np.linspace(rows[0], rows[-1] + 1, threads + 1).astype(int).tolist()
            for own, first, last in zip(shares, ends[:-1], ends[1:], strict=True):
                if last > first:
                    physics = RoverPhysics(model, self._robot, last - first, self.settings)
                    own.append(_Share(world, slice(first, last), physics, Lidar(scene, self._robot, angles)))
        return shares

    def reset(self, mask: Tensor, poses: Tensor) -> RoverState:
        """Places the selected rovers on the ground, at rest. See :meth:`Simulator.reset`."""

        def place(share: _Share, local: np.ndarray) -> None:
            rows = torch.from_numpy(share.rows.start + local)
            position, rotation = rest_on_ground(share.world, self._robot, poses[rows])
            share.physics.place(local, position.numpy(), matrix_to_quaternion(rotation).numpy())
            self._contact[rows.numpy()] = False

        self._update(place, mask.numpy())
        self._drive.reset(mask)
        return self.state()

    def set_dynamics(self, mask: Tensor, dynamics: Dynamics) -> None:
        """Sets the dynamics of the selected rovers. See :meth:`Simulator.set_dynamics`."""
        factors = torch.stack((dynamics.friction, dynamics.chassis_mass, dynamics.motor_torque), -1).double()
        for share in (share for shares in self._threads for share in shares):
            for row in np.flatnonzero(mask.numpy()[share.rows]).tolist():
                share.physics.set_dynamics(row, factors[share.rows.start + row].tolist())

    def step(self, commands: Tensor, active: Tensor | None = None, scanned: Tensor | None = None) -> RoverState:
        """Advances the rovers by one control step of ``substeps`` physics steps. See :meth:`Simulator.step`."""
        speeds, angles = (targets.numpy() for targets in self._drive.advance(commands, active))

        def advance(share: _Share, local: np.ndarray) -> None:
            rows = share.rows.start + local
            self._contact[rows, 0] = share.physics.step(local, speeds[rows], angles[rows])

        self._update(advance, *(None if mask is None else mask.numpy() for mask in (active, scanned)))
        return self.state()

    def state(self) -> RoverState:
        """Returns the current state in new tensors."""
        return self._drive.state(*(torch.from_numpy(a.copy()) for a in (self._body, self._ranges, self._contact)))

    def render(self, row: int, view: View, width: int, height: int, goal: Tensor | None = None) -> Tensor:
        """Renders one rover. See :meth:`Simulator.render`."""
        pose = torch.from_numpy(self._body[row, :7])
        return self._renderers.render(self._worlds[row], pose, view, width, height, goal)

    @property
    def robot_connected(self) -> bool:
        """Whether the rovers are connected. Always true in simulation."""
        return True

    def close(self) -> None:
        """Stops the threads and releases the renderers. Idempotent."""
        if self._pool is not None:
            self._pool.shutdown()
        self._renderers.close()

    def _update(
        self, change: Callable[[_Share, np.ndarray], None], mask: np.ndarray | None, scanned: np.ndarray | None = None
    ) -> None:
        """Changes the selected rovers and reads their poses, joints and scans, on all threads.

        Args:
            change: function of a share and the indices ``[k]`` of the selected rovers within it.
            mask: selected rovers, bool ``[N]``. ``None`` selects all.
            scanned: those that scan, bool ``[N]``. ``None``: all.
        """

        def run(shares: list[_Share]) -> None:
            for share in shares:
                local = share.all if mask is None else np.flatnonzero(mask[share.rows])
                if len(local):
                    change(share, local)
                    self._read(share, local, scanned)

        others = [self._pool.submit(run, shares) for shares in self._threads[1:]] if self._pool else []
        run(self._threads[0])
        for other in others:
            other.result()

    def _read(self, share: _Share, local: np.ndarray, scanned: np.ndarray | None) -> None:
        reading = share.physics.read(local)
        rows = share.rows.start + local
        self._body[rows, :3] = reading.position
        self._body[rows, 3:7] = np.roll(reading.orientation, -1, axis=1)
        self._body[rows, 7:] = reading.joints
        chosen = np.arange(len(local)) if scanned is None else np.flatnonzero(scanned[rows])
        if len(chosen):
            self._ranges[rows[chosen]] = share.lidar.scan(reading.position[chosen], reading.orientation[chosen])


class _Share:
    """Consecutive rovers in the same world that one thread simulates."""

    def __init__(self, world: World, rows: slice, physics: RoverPhysics, lidar: Lidar) -> None:
        self.world = world
        self.rows = rows
        self.all = np.arange(rows.stop - rows.start)
        self.physics = physics
        self.lidar = lidar
