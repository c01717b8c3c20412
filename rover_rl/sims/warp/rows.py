"""The state of all rovers in torch's memory, as kernels see it."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from rover_rl.sims.robots import Robot
from rover_rl.sims.warp.figures import Figures
from rover_rl.sims.warp.kernels.types import Rovers
from rover_rl.sims.warp.library import wp


class Rows:
    """A row for each rover; the tensors here and the arrays of ``rovers`` are the same memory.

    Args:
        figures: of the robot.
        robot: gives its motors' torque.
        count: rovers.
        beams: of a scan.
        device: of the tensors.

    Attributes:
        rovers: what kernels are given.
        poses: of base frames to be placed at, position and quaternion (x, y, z, w), ``[N, 7]``.
        speeds: that the left and the right wheels are to hold, ``[N, 2]``, rad/s.
        active: for which time passes, bool ``[N]``.
        body: position (m) and orientation of the base frame, mean speed (rad/s) of left and right wheels, ``[N, 9]``.
        ranges: scans, ``[N, beams]``, m.
    """

    def __init__(self, figures: Figures, robot: Robot, count: int, beams: int, device: torch.device) -> None:
        self._figures = figures
        self._device = device
        wheels = len(figures.hubs)
        self.poses = self._zeros(count, 7)
        self.speeds = self._zeros(count, 2)
        self.active = torch.ones(count, dtype=torch.bool, device=device)
        self.body = self._zeros(count, 9)
        self.ranges = self._zeros(count, beams)
        mass, center, inertia = figures.total(np.full(count, figures.chassis_mass))
        rovers = Rovers()
        rovers.position = self._shared(self._zeros(count, 3), wp.vec3)
        rovers.orientation = self._shared(self._zeros(count, 4), wp.quat)
        rovers.velocity = self._shared(self._zeros(count, 3), wp.vec3)
        rovers.angular_velocity = self._shared(self._zeros(count, 3), wp.vec3)
        rovers.spins = self._shared(self._zeros(count, wheels), wp.float32)
        # Three for each of a wheel's two contacts with the ground, and its motor's.
        rovers.impulses = self._shared(self._zeros(count, 7 * wheels), wp.float32)
        rovers.mass = self._shared(self._tensor(mass), wp.float32)
        rovers.center = self._shared(self._tensor(center), wp.vec3)
        rovers.inertia = self._shared(self._tensor(inertia), wp.mat33)
        rovers.inverse_inertia = self._shared(self._tensor(np.linalg.inv(inertia)), wp.mat33)
        rovers.grip = self._shared(torch.ones(count, device=device), wp.float32)
        rovers.torque = self._shared(torch.full((count,), robot.wheel_torque, device=device), wp.float32)
        rovers.speeds = self._shared(self.speeds, wp.vec2)
        rovers.active = self._shared(self.active, wp.bool)
        rovers.body = self._shared(self.body, wp.float32)
        rovers.ranges = self._shared(self.ranges, wp.float32)
        self.rovers = rovers

    def _zeros(self, *shape: int) -> Tensor:
        return torch.zeros(shape, device=self._device)

    def _tensor(self, values: np.ndarray) -> Tensor:
        return torch.tensor(values, dtype=torch.float32, device=self._device)

    def _shared(self, tensor: Tensor, dtype: type) -> wp.array:
        return wp.from_torch(tensor, dtype=dtype)
