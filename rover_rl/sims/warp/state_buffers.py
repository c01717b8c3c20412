"""The state of all rovers in torch's memory, as kernels see it."""

from __future__ import annotations

import torch
from torch import Tensor

from rover_rl.sims.base import Dynamics
from rover_rl.sims.robots import Robot
from rover_rl.sims.warp.inertial_model import InertialModel
from rover_rl.sims.warp.kernels.types import Rovers
from rover_rl.sims.warp.library import wp


class StateBuffers:
    """A row for each rover; the tensors here and the arrays of ``rovers`` are the same memory.

    Args:
        model: of the robot.
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

    def __init__(self, model: InertialModel, robot: Robot, count: int, beams: int, device: torch.device) -> None:
        self._model = model
        self._device = device
        wheels = len(model.hubs)
        self.poses = self._zeros(count, 7)
        self.speeds = self._zeros(count, 2)
        self.active = torch.ones(count, dtype=torch.bool, device=device)
        self.body = self._zeros(count, 9)
        self.ranges = self._zeros(count, beams)
        self._torque = robot.wheel_torque
        self._mass, self._grip, self._motors = self._zeros(count), self._zeros(count), self._zeros(count)
        self._center, self._inertia, self._inverse = (self._zeros(count, *size) for size in ((3,), (3, 3), (3, 3)))
        rovers = Rovers()
        rovers.position = self._shared(self._zeros(count, 3), wp.vec3)
        rovers.orientation = self._shared(self._zeros(count, 4), wp.quat)
        rovers.velocity = self._shared(self._zeros(count, 3), wp.vec3)
        rovers.angular_velocity = self._shared(self._zeros(count, 3), wp.vec3)
        rovers.spins = self._shared(self._zeros(count, wheels), wp.float32)
        # Three for each of a wheel's two contacts with the ground, and its motor's.
        rovers.impulses = self._shared(self._zeros(count, 7 * wheels), wp.float32)
        rovers.mass = self._shared(self._mass, wp.float32)
        rovers.center = self._shared(self._center, wp.vec3)
        rovers.inertia = self._shared(self._inertia, wp.mat33)
        rovers.inverse_inertia = self._shared(self._inverse, wp.mat33)
        rovers.grip = self._shared(self._grip, wp.float32)
        rovers.torque = self._shared(self._motors, wp.float32)
        rovers.speeds = self._shared(self.speeds, wp.vec2)
        rovers.active = self._shared(self.active, wp.bool)
        rovers.body = self._shared(self.body, wp.float32)
        rovers.ranges = self._shared(self.ranges, wp.float32)
        self.rovers = rovers
        ones = torch.ones(count, device=device)
        self.set_dynamics(torch.ones(count, dtype=torch.bool, device=device), Dynamics(ones, ones, ones))

    def set_dynamics(self, mask: Tensor, dynamics: Dynamics) -> None:
        """Gives the rovers of ``mask`` these dynamics; where they stand is up to the next placement."""
        mass, center, inertia = self._model.total(self._model.chassis_mass * dynamics.chassis_mass.double())
        varied = (
            (self._mass, mass),
            (self._center, center),
            (self._inertia, inertia),
            (self._inverse, _inverse(inertia)),
            (self._grip, dynamics.friction),
            (self._motors, self._torque * dynamics.motor_torque),
        )
        for values, new in varied:
            rows = mask.reshape(-1, *[1] * (new.ndim - 1))
            values.copy_(torch.where(rows, new.to(values.dtype), values))

    def _zeros(self, *shape: int) -> Tensor:
        return torch.zeros(shape, device=self._device)

    def _shared(self, tensor: Tensor, dtype: type) -> wp.array:
        return wp.from_torch(tensor, dtype=dtype)


def _inverse(matrices: Tensor) -> Tensor:
    """Of ``[N, 3, 3]``, each by itself, by cross products of its rows."""
    a, b, c = matrices.unbind(-2)
    columns = torch.stack((torch.linalg.cross(b, c), torch.linalg.cross(c, a), torch.linalg.cross(a, b)), -1)
    return columns / (a * columns[..., 0]).sum(-1)[:, None, None]
