"""Lidar of simulators that have none of their own: the planar one of the Warp backend."""

from __future__ import annotations

import torch
from torch import Tensor

from rover_rl.native.warp import launch_options, wp
from rover_rl.robots import Robot
from rover_rl.sims.base import Simulator
from rover_rl.sims.rays import RayCaster
from rover_rl.sims.rover_state import beam_angles
from rover_rl.sims.warp.kernels.lidar import scan
from rover_rl.sims.warp.kernels.scan_plane import SECTORS
from rover_rl.sims.warp.kernels.types import RobotModel, RoverArrays
from rover_rl.worlds.table import WorldTable


class PlaneScanner:
    """Lidar on the rovers of any simulator, by the poses in its state: see :class:`~rover_rl.sims.base.Scanner`.

    It intersects the plane of a scan with what does not move in the worlds of the rows, as the Warp backend does.
    """

    def __init__(self, simulator: Simulator, worlds: WorldTable, robot: Robot, beams: int) -> None:
        count, device, angles = simulator.num_envs, simulator.device, beam_angles(beams)
        self.angles = angles.float().to(device)
        self._simulator, self._caster = simulator, RayCaster(worlds)
        beam = torch.stack((angles.cos(), angles.sin()), -1).float().to(device)
        self._beams = wp.from_torch(beam, dtype=wp.vec2)
        model = RobotModel()
        model.lidar_position, model.lidar_range = wp.vec3(*robot.lidar_position), robot.lidar_range
        self._models = wp.array([model], dtype=RobotModel, device=wp.device_from_torch(device))
        self._poses, self._ranges = torch.zeros(count, 7, device=device), torch.zeros(count, beams, device=device)
        self._scanned, self._slots = torch.ones(count, dtype=torch.bool, device=device), worlds.slots.int()
        self._rovers = RoverArrays()
        self._rovers.base_state, self._rovers.ranges = wp.from_torch(self._poses), wp.from_torch(self._ranges)
        self._rovers.scanned, self._rovers.scene = wp.from_torch(self._scanned), wp.from_torch(self._slots)
        self._rovers.robot = wp.from_torch(torch.zeros_like(self._slots))
        self._rovers.visible = wp.from_torch(torch.zeros(count, SECTORS, device=device))

    def scan(self, rows: Tensor | None = None) -> Tensor:
        state, (scenes, slots) = self._simulator.state(), self._caster.scenes()
        self._poses[:, :3], self._poses[:, 3:] = state.position, state.orientation
        self._slots.copy_(slots)
        self._scanned.copy_(self._scanned.new_ones(()) if rows is None else rows)
        inputs = [scenes, self._models, self._rovers, self._beams, 0, 1]
        wp.launch(scan, (len(slots), 1), inputs, **launch_options(slots.device))
        return self._ranges.clone()
