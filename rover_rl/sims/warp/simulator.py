"""The Warp backend behind the :class:`Simulator` seam."""

from __future__ import annotations

import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from itertools import groupby
from typing import Any

import numpy as np
import torch
from torch import Tensor

from rover_rl.sims.base import Dynamics, RoverState, View
from rover_rl.sims.differential_drive import SimulatedDrive
from rover_rl.sims.rendering.cache import RendererCache
from rover_rl.sims.robots import Robot
from rover_rl.sims.rotations import matrix_to_quaternion
from rover_rl.sims.warp.inertial_model import read_inertial_model
from rover_rl.sims.warp.kernels.dynamics import place, step_dynamics
from rover_rl.sims.warp.kernels.lidar import scan
from rover_rl.sims.warp.kernels.types import Solver
from rover_rl.sims.warp.library import wp
from rover_rl.sims.warp.scene import make_rover, make_scene
from rover_rl.sims.warp.settings import WarpSettings
from rover_rl.sims.warp.state_buffers import StateBuffers
from rover_rl.sims.worlds import World, rest_on_ground

ROWS_A_THREAD = 16
"""Rovers that another thread of the CPU is worth."""
BLOCK_THREADS = 32
"""Of a GPU, one warp: a few thousand rovers are spread over all multiprocessors. A CPU has no blocks."""


class WarpSimulator:
    """Rovers in Warp: a kernel for the physics of a control step and one for the lidar, a thread a rover.

    Args:
        worlds: the world of each rover. Neighbours in the same world are launched together, and do not notice.
        robot: the rover.
        lidar_beams: beams of a scan, spread evenly over the full turn from straight ahead counter-clockwise.
        settings: of the physics.
        device: where it runs and where its tensors are; ``None``: the CPU.

    Raises:
        ValueError: for a robot that the kernels have no room for, or that is not made of boxes and wheels.
    """

    def __init__(
        self,
        worlds: Sequence[World],
        robot: Robot,
        lidar_beams: int,
        settings: WarpSettings | None = None,
        device: torch.device | str | None = None,
    ) -> None:
        self.num_envs = count = len(worlds)
        self.device = torch.device(device or "cpu")
        if self.device.type == "cuda" and self.device.index is None:
            self.device = torch.device("cuda", torch.cuda.current_device())
        self.settings = settings or WarpSettings()
        self.control_dt = self.settings.control_dt
        angles = np.arange(lidar_beams) * (2 * math.pi / lidar_beams)
        self.ray_angles = torch.tensor(angles, dtype=torch.float32, device=self.device)
        self._robot = robot
        self._drive = SimulatedDrive(robot, self.control_dt, count, self.device)
        self._renderers = RendererCache(robot)

        model = read_inertial_model(robot)
        self._buffers = StateBuffers(model, robot, count, lidar_beams, self.device)
        self._rover = make_rover(robot, model, self._wp_device)
        self._worlds = [
            (world, slice((rows := list(block))[0], rows[-1] + 1))
            for world, block in groupby(range(count), key=worlds.__getitem__)
        ]
        self._poses = wp.from_torch(self._buffers.poses)
        directions = np.stack((np.cos(angles), np.sin(angles)), -1)
        self._shards = self._record(wp.array(directions, dtype=wp.vec2, device=self._wp_device))
        self._pool = ThreadPoolExecutor(len(self._shards) - 1) if len(self._shards) > 1 else None
        self.reset(torch.ones(count, dtype=torch.bool, device=self.device), torch.zeros(count, 3, device=self.device))

    @property
    def _wp_device(self) -> wp.Device:
        return wp.device_from_torch(self.device)

    @property
    def _where(self) -> dict[str, Any]:
        """Arguments of every launch."""
        blocks = {"block_dim": BLOCK_THREADS} if self.device.type == "cuda" else {}
        return {"device": self._wp_device, **blocks}

    def _record(self, beams: wp.array) -> list[_Shard]:
        """The launches of each thread: a part of the rovers of every world."""
        threads = self.settings.threads or torch.get_num_threads()
        # Launches on a GPU return at once.
        most = 1 if self.device.type == "cuda" else max(1, self.num_envs // ROWS_A_THREAD)
        shards = [_Shard() for _ in range(min(threads, most))]
        solver, rovers = _solver(self.settings), self._buffers.rovers
        for world, rows in self._worlds:
            scene = make_scene(world, self._rover.reach, self._wp_device)
            ends = np.linspace(rows.start, rows.stop, len(shards) + 1).astype(int).tolist()
            for shard, first, last in zip(shards, ends[:-1], ends[1:], strict=True):
                launch = {"dim": last - first, "record_cmd": True, **self._where}
                if last > first:
                    inputs = [scene, self._rover, solver, rovers, first]
                    shard.drives.append(wp.launch(step_dynamics, inputs=inputs, **launch))
                    shard.scans.append(wp.launch(scan, inputs=[scene, self._rover, rovers, beams, first], **launch))
        return shards

    def reset(self, mask: Tensor, poses: Tensor) -> RoverState:
        """Puts the rovers of ``mask`` on the ground at ``poses``: see :meth:`Simulator.reset`."""
        for world, rows in self._worlds:
            self._stand(world, rows, mask[rows], poses[rows])
        self._buffers.active.copy_(mask)
        inputs = [self._rover, self._buffers.rovers, self._poses]
        wp.launch(place, dim=self.num_envs, inputs=inputs, stream=self._stream, **self._where)
        self.launch(physics=False)
        self._drive.reset(mask)
        return self.state()

    def _stand(self, world: World, rows: slice, mask: Tensor, poses: Tensor) -> None:
        """Works out how the rovers of ``mask`` stand on the ground of their world."""
        target = self._buffers.poses[rows]
        # On the CPU the few rows of a reset are looked for; on a GPU that would wait for the device.
        chosen = mask.nonzero().squeeze(-1) if self.device.type == "cpu" else slice(None)
        position, rotation = rest_on_ground(world, self._robot, poses[chosen])
        target[chosen] = torch.cat((position, matrix_to_quaternion(rotation)), -1).to(target.dtype)

    def set_dynamics(self, mask: Tensor, dynamics: Dynamics) -> None:
        """Gives the rovers of ``mask`` these dynamics: see :meth:`Simulator.set_dynamics`."""
        self._buffers.set_dynamics(mask, dynamics)

    def step(self, commands: Tensor, active: Tensor | None = None) -> RoverState:
        """Drives one control step of ``substeps`` physics steps: see :meth:`Simulator.step`."""
        self._buffers.speeds.copy_(self._drive.advance(commands, active))
        if active is None:
            self._buffers.active.fill_(True)
        else:
            self._buffers.active.copy_(active)
        self.launch()
        return self.state()

    def state(self) -> RoverState:
        """The present state, in tensors of its own."""
        return self._drive.state(self._buffers.body.clone(), self._buffers.ranges.clone())

    def scan_from(self, position: Tensor, orientation: Tensor) -> Tensor:
        """What the lidars would see from other poses of their base frames; moves nothing.

        Args:
            position: ``[N, 3]``, m.
            orientation: unit quaternions (x, y, z, w), ``[N, 4]``.

        Returns:
            Ranges ``[N, beams]``, m.
        """
        body, ranges = self._buffers.body.clone(), self._buffers.ranges.clone()
        self._buffers.body[:, :7] = torch.cat((position, orientation), -1)
        self._buffers.active.fill_(True)
        self.launch(physics=False)
        seen = self._buffers.ranges.clone()
        self._buffers.body.copy_(body)
        self._buffers.ranges.copy_(ranges)
        return seen

    def render(self, row: int, view: View, width: int, height: int, goal: Tensor | None = None) -> Tensor:
        """A picture by Bullet's software renderer: see :meth:`Simulator.render`."""
        world = next(world for world, rows in self._worlds if rows.start <= row < rows.stop)
        return self._renderers.render(world, self._buffers.body[row, :7], view, width, height, goal)

    @property
    def robot_connected(self) -> bool:
        """Always."""
        return True

    def close(self) -> None:
        """Ends its threads and lets go of its renderers; may be called again."""
        if self._pool is not None:
            self._pool.shutdown()
        self._renderers.close()

    @property
    def _stream(self) -> wp.Stream | None:
        """Torch's stream, so that kernels and tensors wait for one another."""
        return wp.stream_from_torch(self.device) if self.device.type == "cuda" else None

    def launch(self, *, physics: bool = True, lidar: bool = True) -> None:
        """Runs the kernels for all active rovers: a control step's physics, and the lidar."""
        run = partial(_Shard.launch, physics=physics, lidar=lidar, stream=self._stream)
        others = [self._pool.submit(run, shard) for shard in self._shards[1:]] if self._pool else []
        run(self._shards[0])
        for other in others:
            other.result()


class _Shard:
    """The recorded launches of one thread: for each world a part of its rovers."""

    def __init__(self) -> None:
        self.drives: list[wp.Launch] = []
        self.scans: list[wp.Launch] = []

    def launch(self, *, physics: bool, lidar: bool, stream: wp.Stream | None) -> None:
        for drives, scans in zip(self.drives, self.scans, strict=True):
            if physics:
                drives.launch(stream)
            if lidar:
                scans.launch(stream)


def _solver(settings: WarpSettings) -> Solver:
    solver = Solver()
    solver.dt = settings.substep
    solver.substeps = settings.substeps
    solver.iterations = settings.solver_iterations
    # Half of a wheel's: it has two contacts. An implicit spring and damper (R. Smith, Open Dynamics Engine, 3.8).
    spring, damper = settings.stiffness / 2 * settings.substep, settings.damping / 2
    solver.correction = spring / (spring + damper)
    solver.softness = 1 / (settings.substep * (spring + damper))
    solver.max_correction = settings.max_correction
    solver.margin = settings.margin
    solver.ground_friction = settings.ground_friction
    solver.obstacle_friction = settings.obstacle_friction
    return solver
