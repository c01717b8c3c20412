"""Simulator of level worlds: the planar tier of the Warp backend."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import partial

import torch

from rover_rl.native.warp import wp
from rover_rl.robots import Robot
from rover_rl.robots.fleet import Fleet
from rover_rl.sims.base import Feature
from rover_rl.sims.movers.field import MoverField
from rover_rl.sims.scenes.table import Contents, SceneTable
from rover_rl.sims.warp.planar.dynamics import PlanarSolver, place_planar, step_planar
from rover_rl.sims.warp.planar.lidar import scan_planar
from rover_rl.sims.warp.planar.plan import Plan, plan_contents, plan_problem
from rover_rl.sims.warp.planar.robots import PlanarRobots
from rover_rl.sims.warp.planar.view import look
from rover_rl.sims.warp.simulator import WarpSimulator
from rover_rl.worlds import World
from rover_rl.worlds.movers.part_kernels import PartArrays


class PlanarSimulator(WarpSimulator):
    """Batch of rovers on level ground between upright obstacles, with three degrees of freedom each.

    It measures no forces. Raises ``ValueError`` for a world or a robot that is not level: see
    :func:`rover_rl.sims.warp.planar.plan.plan_problem`.
    """

    features: frozenset[Feature] = WarpSimulator.features - {"contact_force", "wheel_torque"}
    is_level = True
    _step, _place, _scan = step_planar, place_planar, scan_planar
    _prepare, _compile = (*WarpSimulator._prepare, look), ((step_planar, scan_planar),)

    def _make_tables(self) -> tuple[PlanarRobots, SceneTable]:
        robots = PlanarRobots(self.fleet, self._wp_device)
        contents = partial(_checked_contents, robots=robots)
        return robots, SceneTable(self._worlds.capacity, self._wp_device, Plan, contents)

    def _record_dynamics(self) -> list[wp.Launch]:
        solver, settings = PlanarSolver(), self.settings
        solver.dt, solver.substeps, solver.iterations = settings.substep, settings.substeps, settings.solver_iterations
        solver.ground_friction, solver.obstacle_friction = settings.ground_friction, settings.obstacle_friction
        return self._record(self._step, solver, self._buffers.rovers, self._arrays(PartArrays))

    def _follow_forms(self, movers: MoverField) -> None:
        """The kernels read kinds and sizes of parts, and no solids."""


def planar_problem(worlds: Iterable[World], robots: Sequence[Robot]) -> str | None:
    """Tells why the planar tier cannot simulate robots in worlds, in a sentence; ``None`` if it can."""
    try:
        known = PlanarRobots(Fleet(robots, torch.zeros(1, dtype=torch.int64)), wp.get_device("cpu"))
        for world in worlds:
            _check_level(world, known)
    except ValueError as error:
        return str(error)
    return None


def _check_level(world: World, robots: PlanarRobots) -> None:
    if problem := plan_problem(world, robots.highest_axle, robots.tops, robots.lidars):
        raise ValueError(f"physics='planar' needs level worlds, and {world.name!r} {problem}; use physics='full'")


def _checked_contents(world: World, robots: PlanarRobots) -> Contents:
    _check_level(world, robots)
    return plan_contents(world, robots.reach, robots.sight, robots.lidars)
