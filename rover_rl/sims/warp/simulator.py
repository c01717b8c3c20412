"""Simulator of the Warp backend, an implementation of :class:`rover_rl.sims.base.Simulator`."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from torch import Tensor

from rover_rl.native.warp import loading, stream_of, wp
from rover_rl.robots import Robot
from rover_rl.robots.fleet import Fleet
from rover_rl.sims.base import Feature, Simulator, View
from rover_rl.sims.free_space.kernels import find_headings
from rover_rl.sims.movers.field import MoverField, shown_parts
from rover_rl.sims.rendering.cache import RendererCache
from rover_rl.sims.rover_state import Dynamics, Force, RoverState, SimulatedDrives, beam_angles
from rover_rl.sims.scenes.table import SceneTable
from rover_rl.sims.warp import WarpSettings
from rover_rl.sims.warp.kernels.dynamics import step_dynamics
from rover_rl.sims.warp.kernels.lidar import scan
from rover_rl.sims.warp.kernels.placing import place
from rover_rl.sims.warp.kernels.scan_plane import SECTORS
from rover_rl.sims.warp.kernels.types import MoverArrays, Solver
from rover_rl.sims.warp.models import ModelTable, StateBuffers
from rover_rl.worlds import Terrain, World, hull
from rover_rl.worlds.ground_kernels import measure_clearance
from rover_rl.worlds.movers.parts import Parts
from rover_rl.worlds.table import WorldTable, in_threads

MIN_ROVERS_PER_THREAD = 16
"""Minimum number of rovers per CPU thread; with fewer, another thread does not pay."""
HEAVY = 100.0
"""Mass of a robot above which stiffness and damping of its contacts are in proportion to the mass, kg."""
GPU_BLOCK_SIZE = 32
"""Threads per block on a GPU: one warp, so that a few thousand rovers spread over all multiprocessors."""
GPU_LIDAR_LANES = 4
"""Threads that scan for one rover on a GPU: see :class:`WarpSettings`."""


class WarpSimulator(Simulator):
    """Batch of rovers simulated by Warp kernels, a thread each, on a device: by default the CPU.

    All rovers share a launch, whatever world they are in; they do not interact. ``robot`` may be a fleet. Raises
    ``ValueError`` for a robot with too many wheels.
    """

    features: frozenset[Feature] = frozenset(
        {"contacts", "dynamics", "lidar", "movers", "robots", "worlds", "contact_force", "wheel_torque"}
    )

    _step, _place, _scan = step_dynamics, place, scan
    """Kernels that advance rovers by a control step, place them, and scan."""
    _prepare: tuple[wp.Kernel, ...] = (measure_clearance, find_headings)
    """A kernel of each module that prepares worlds. These compile first."""
    _compile: tuple[tuple[wp.Kernel, ...], ...] = (step_dynamics,), (place, scan)
    """A kernel of each module of a step: those that compile after the first, and those in a thread of their own."""

    def __init__(
        self,
        worlds: Sequence[World],
        robot: Robot | Fleet,
        settings: WarpSettings | None = None,
        device: torch.device | str | None = None,
    ) -> None:
        self.num_envs = count = len(worlds)
        self.device = torch.device(device or "cpu")
        if self.device.type == "cuda" and self.device.index is None:
            self.device = torch.device("cuda", torch.cuda.current_device())
        self.settings = settings or WarpSettings()
        self.control_dt = self.settings.control_dt
        self.fleet = Fleet.of(robot, count, self.device)
        self._drive = SimulatedDrives(self.fleet, self.control_dt)
        self._renderers: dict[Robot, RendererCache] = {}
        self._wp_device = wp.device_from_torch(self.device)
        blocks = {"block_dim": self.settings.block_size or GPU_BLOCK_SIZE} if self.device.type == "cuda" else {}
        self._options = {"device": self._wp_device, **blocks}
        preparing, *stepping = self.begin_loading(self.settings, self.device)
        self._buffers = StateBuffers(self.fleet)
        self._worlds = WorldTable.of(worlds, self.device)
        self._entered = self._worlds.follow()
        self._models, self._scenes = self._make_tables()
        preparing.result()
        self.enter_worlds()
        for kernels in stepping:
            kernels.result()
        self._poses = wp.from_torch(self._buffers.poses, dtype=wp.vec3)
        self._shards = self._divide()
        self._pool = ThreadPoolExecutor(len(self._shards) - 1) if len(self._shards) > 1 else None
        self._movers: MoverField | None = None
        self._parts: Parts | None = None
        self._dynamics = self._record_dynamics()
        self.reset(torch.ones(count, dtype=torch.bool, device=self.device), torch.zeros(count, 3, device=self.device))

    @classmethod
    def begin_loading(cls, settings: WarpSettings, device: torch.device) -> list[Future[None]]:
        """Loads the kernels that prepare worlds, and those of a step, which compile while worlds are prepared."""
        size = (settings.block_size or GPU_BLOCK_SIZE) if device.type == "cuda" else None
        worlds, *threads = (tuple(kernel.module for kernel in some) for some in (cls._prepare, *cls._compile))
        first, *others = ((str(wp.device_from_torch(device)), size, modules) for modules in threads)
        return [*loading(("cpu", None, worlds), first), *(loading(other)[0] for other in others)]

    def _make_tables(self) -> tuple[Any, SceneTable]:
        """Makes the tables of the robots, by index, and of the worlds, by slot, that the kernels read."""
        models = ModelTable(self.fleet, self._wp_device)
        self._forms, self._form_count = SceneTable.of_solids(1, models.reach, self._wp_device), 0
        return models, SceneTable.of_solids(self._worlds.capacity, models.reach, self._wp_device)

    def _divide(self) -> list[tuple[int, int]]:
        """First rover and number of rovers of each CPU thread."""
        threads = self.settings.threads or torch.get_num_threads()
        # Launches on a GPU are asynchronous: one host thread suffices.
        max_threads = 1 if self.device.type == "cuda" else max(1, self.num_envs // MIN_ROVERS_PER_THREAD)
        ends = np.linspace(0, self.num_envs, min(threads, max_threads) + 1).astype(int).tolist()
        return [(first, last - first) for first, last in pairwise(ends)]

    def _record(self, kernel: wp.Kernel, *inputs: Any, lanes: tuple[int, ...] = ()) -> list[wp.Launch]:
        """Records the launches of a kernel, one per CPU thread, with ``lanes`` threads of the device per rover."""
        inputs = (self._scenes.scenes, self._models.models, *inputs)
        return [
            wp.launch(kernel, dim=(count, *lanes), inputs=[*inputs, first, *lanes], record_cmd=True, **self._options)
            for first, count in self._shards
        ]

    def _record_dynamics(self) -> list[wp.Launch]:
        """Records the physics of a control step, with the parts of movers that are there now."""
        solver = _solver(self.settings, max(robot.mass for robot in self.fleet.robots))
        return self._record(self._step, solver, self._buffers.rovers, self._forms.scenes, self._arrays(MoverArrays))

    def _arrays(self, struct: Any) -> Any:
        """Returns a struct of the parts of movers that are there now."""
        arrays = struct()
        for name, variable in struct.vars.items():
            dtype = variable.type.dtype
            if self._parts is None:
                setattr(arrays, name, wp.empty((self.num_envs, 0), dtype=dtype, device=self._wp_device))
            else:
                setattr(arrays, name, wp.from_torch(getattr(self._parts, name), dtype=dtype))
        return arrays

    def measure(self, fields: Collection[Force]) -> None:
        self._buffers.measure(fields)
        self._dynamics = self._record_dynamics()

    def add_movers(self, movers: MoverField) -> None:
        self._movers = movers

    def _follow_movers(self) -> None:
        """Reads the parts of movers where they are in memory, after that has changed."""
        if self._movers is None or self._movers.parts is None:
            return
        self._follow_forms(self._movers)
        if self._parts is not self._movers.parts:
            self._parts = self._movers.parts
            self._dynamics = self._record_dynamics()

    def _follow_forms(self, movers: MoverField) -> None:
        """Copies the solids of the parts of movers, each in its own frame, to a scene."""
        if self._form_count != len(movers.forms):
            self._form_count = len(movers.forms)
            solids = [hull(form.corners()) for form in movers.forms]
            with wp.ScopedStream(stream_of(self.device)):
                self._forms[0] = World("forms", Terrain.flat((4.0, 4.0)), solids)

    def scanner(self, beams: int) -> WarpScanner:
        scanner = WarpScanner(self, beams, self._models.ranges)
        angles = beam_angles(beams).numpy()
        directions = wp.array(np.stack((np.cos(angles), np.sin(angles)), -1), dtype=wp.vec2, device=self._wp_device)
        rovers = self._buffers.struct(scanned=scanner.rows, ranges=scanner.ranges, visible=scanner.visible)
        scanner.launches = self._record(self._scan, rovers, directions, lanes=(scanner.lanes,))
        return scanner

    def enter_worlds(self) -> None:
        worlds = self._entered()
        in_threads(self._scenes.prepare, worlds.values())
        # Copies wait for kernels that still read the slot's world before, and kernels for the copies.
        with wp.ScopedStream(stream_of(self.device)):
            for slot, world in worlds.items():
                self._scenes[slot] = world
        self._buffers.tensors["scene"].copy_(self._worlds.slots)

    def prepare_world(self, world: World) -> None:
        self._scenes.prepare(world)

    def enter_robots(self, mask: Tensor) -> None:
        self._buffers.enter_robots(mask)

    def reset(self, mask: Tensor, poses: Tensor) -> RoverState:
        self._buffers.poses.copy_(poses)
        self._buffers.tensors["active"].copy_(mask)
        inputs = [self._scenes.scenes, self._models.models, self._buffers.rovers, self._poses]
        wp.launch(self._place, dim=self.num_envs, inputs=inputs, stream=stream_of(self.device), **self._options)
        self._drive.reset(mask)
        return self.state()

    def set_dynamics(self, mask: Tensor, dynamics: Dynamics) -> None:
        self._buffers.set_dynamics(mask, dynamics)

    def step(self, commands: Tensor, active: Tensor | None = None) -> RoverState:
        targets, tensors = self._drive.advance(commands, active), self._buffers.tensors
        tensors["target_speeds"].copy_(targets.speeds)
        tensors["target_angles"].copy_(targets.angles)
        _mark(tensors["active"], active)
        self._follow_movers()
        self.launch()
        return self.state()

    def state(self) -> RoverState:
        body, *touched = (self._buffers.tensors[name] for name in ("base_state", "contact", "mover_contact"))
        contacts = [one.clone()[:, None] for one in touched[: 1 if self._parts is None else 2]]
        reports = {name: values.clone() for name, values in self._buffers.reports.items()}
        return self._drive.state(body.clone(), *contacts, **reports)

    def render(self, row: int, view: View, width: int, height: int, goal: Tensor | None = None) -> Tensor:
        pose, movers = self._buffers.tensors["base_state"][row, :7], shown_parts(self._movers, row)
        renderers = self._renderers.setdefault(self.fleet[row], RendererCache(self.fleet[row]))
        return renderers.render(self._worlds[row], pose, view, width, height, goal, movers)

    def close(self) -> None:
        """Stops the threads and releases the renderers. Idempotent."""
        if self._pool is not None:
            self._pool.shutdown()
        for renderers in self._renderers.values():
            renderers.close()

    def launch(self) -> None:
        self.run(self._dynamics)

    def run(self, recorded: Sequence[wp.Launch]) -> None:
        """Launches a recorded kernel on each thread and waits for them on the CPU; on a GPU, returns immediately."""
        stream = None if self.device.type == "cpu" else stream_of(self.device)
        others = [self._pool.submit(launch.launch, stream) for launch in recorded[1:]] if self._pool else []
        recorded[0].launch(stream)
        for other in others:
            other.result()


class WarpScanner:
    """Lidar on every rover: see :class:`rover_rl.sims.base.Scanner`. On a GPU, several threads share the scan of one.

    Attributes:
        rows: rovers that the next launch scans for, bool ``[N]``.
        ranges: last scan of each rover, ``[N, beams]``, m.
        visible: working memory of the kernel.
        lanes: number of threads per rover.
        launches: recorded launches of the kernel.
    """

    def __init__(self, simulator: WarpSimulator, beams: int, reach: Tensor) -> None:
        count, device = simulator.num_envs, simulator.device
        self.angles = beam_angles(beams).float().to(device)
        self.rows = torch.ones(count, dtype=torch.bool, device=device)
        self.ranges = torch.zeros(count, beams, device=device)
        self.visible = torch.zeros(count, SECTORS, device=device)
        self.lanes = simulator.settings.lidar_lanes or (GPU_LIDAR_LANES if device.type == "cuda" else 1)
        self.launches: list[wp.Launch] = []
        self._simulator, self._reach = simulator, reach

    def scan(self, rows: Tensor | None = None) -> Tensor:
        _mark(self.rows, rows)
        self.launch()
        return self.ranges.clone()

    def launch(self) -> None:
        """Launches the kernel for the rovers of :attr:`rows`."""
        if self.lanes > 1:
            self.ranges.masked_fill_(self.rows[:, None], torch.inf)
            self.visible.copy_(self._reach[self._simulator.fleet.index][:, None])
        self._simulator.run(self.launches)


def _mark(rows: Tensor, chosen: Tensor | None) -> None:
    """Writes which rows are chosen, bool ``[N]``. ``None``: all."""
    if chosen is None:
        rows.fill_(True)
    else:
        rows.copy_(chosen)


def _solver(settings: WarpSettings, mass: float) -> Solver:
    """Converts settings to the solver parameters of the kernels, for robots of a mass (kg) at most."""
    solver, share = Solver(), max(1.0, mass / HEAVY)
    solver.dt, solver.substeps, solver.iterations = settings.substep, settings.substeps, settings.solver_iterations
    # A wheel has two contacts, each with half of its stiffness k and damping d. Implicit spring-damper with the time
    # step h: ERP = h k / (h k + d), and CFM = 1 / (h k + d) for forces, divided by h for impulses (R. Smith, Open
    # Dynamics Engine user guide, 3.8).
    spring, damper = share * settings.stiffness / 2 * settings.substep, share * settings.damping / 2
    solver.error_reduction = spring / (spring + damper)
    solver.softness = 1 / (settings.substep * (spring + damper))
    for name in ("max_correction", "margin", "ground_friction", "obstacle_friction"):
        setattr(solver, name, getattr(settings, name))
    return solver
