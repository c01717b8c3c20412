"""State of all rovers in memory shared by torch and Warp."""

from __future__ import annotations

import torch
from torch import Tensor

from rover_rl.sims.base import Dynamics
from rover_rl.sims.native.warp import wp
from rover_rl.sims.robots import Robot
from rover_rl.sims.robots.inertial_model import InertialModel
from rover_rl.sims.warp.kernels.scan_plane import SECTORS
from rover_rl.sims.warp.kernels.types import RoverArrays


class StateBuffers:
    """State and parameters of all rovers, a row each. Torch tensors and Warp arrays share the same memory.

    Args:
        model: inertial model of the robot.
        robot: robot, whose drive has the joints.
        count: number of rovers.
        beams: number of beams of a scan.
        device: device of the tensors.

    Attributes:
        rovers: Warp arrays for the kernels.
        poses: poses of the base frames for the next placement, position (m) and quaternion (x, y, z, w), ``[N, 7]``.
        scene: index of each rover's world in the array of scenes, int32 ``[N]``.
        target_speeds: target speed of each motor, ``[N, M]``, rad/s.
        target_angles: target angle of each steering joint, ``[N, S]``, rad.
        active: rovers that the next launch simulates, bool ``[N]``.
        scanned: those whose lidar scans, bool ``[N]``.
        base_state: position (m) and orientation (x, y, z, w) of the base frame, mean speed of the wheels of each motor
            (rad/s) and angle of each steering joint (rad), ``[N, 7 + M + S]``.
        ranges: scans, ``[N, beams]``, m.
        contact: whether the rovers touched an obstacle in the last control step, bool ``[N, 1]``.
    """

    def __init__(self, model: InertialModel, robot: Robot, count: int, beams: int, device: torch.device) -> None:
        self._model = model
        self._device = device
        wheels, motors, steering = len(model.hubs), len(robot.drive.motors), len(robot.drive.steering)
        self.poses = self._zeros(count, 7)
        self.scene = torch.zeros(count, dtype=torch.int32, device=device)
        self.target_speeds = self._zeros(count, motors)
        self.target_angles = self._zeros(count, steering)
        self._angles = self._zeros(count, steering)
        self.active = torch.ones(count, dtype=torch.bool, device=device)
        self.scanned = self.active.clone()
        self.base_state = self._zeros(count, 7 + motors + steering)
        self.ranges = self._zeros(count, beams)
        self.contact = torch.zeros(count, 1, dtype=torch.bool, device=device)
        self._visible = self._zeros(count, SECTORS)
        self._lidar_range = robot.lidar_range
        self._wheel_torque = robot.drive.torque
        self._mass = self._zeros(count)
        self._center = self._zeros(count, 3)
        self._inertia = self._zeros(count, 3, 3)
        self._inverse_inertia = self._zeros(count, 3, 3)
        self._friction_scale = self._zeros(count)
        self._motor_torque = self._zeros(count)
        rovers = RoverArrays()
        rovers.position = self._shared(self._zeros(count, 3), wp.vec3)
        rovers.orientation = self._shared(self._zeros(count, 4), wp.quat)
        rovers.velocity = self._shared(self._zeros(count, 3), wp.vec3)
        rovers.angular_velocity = self._shared(self._zeros(count, 3), wp.vec3)
        rovers.wheel_spins = self._shared(self._zeros(count, wheels), wp.float32)
        # Three impulses for each of the two ground contacts of a wheel, and one for its motor.
        rovers.impulses = self._shared(self._zeros(count, 7 * wheels), wp.float32)
        rovers.mass = self._shared(self._mass, wp.float32)
        rovers.center = self._shared(self._center, wp.vec3)
        rovers.inertia = self._shared(self._inertia, wp.mat33)
        rovers.inverse_inertia = self._shared(self._inverse_inertia, wp.mat33)
        rovers.friction_scale = self._shared(self._friction_scale, wp.float32)
        rovers.motor_torque = self._shared(self._motor_torque, wp.float32)
        rovers.scene = self._shared(self.scene, wp.int32)
        rovers.target_speeds = self._shared(self.target_speeds, wp.float32)
        rovers.target_angles = self._shared(self.target_angles, wp.float32)
        rovers.angles = self._shared(self._angles, wp.float32)
        rovers.active = self._shared(self.active, wp.bool)
        rovers.scanned = self._shared(self.scanned, wp.bool)
        rovers.base_state = self._shared(self.base_state, wp.float32)
        rovers.ranges = self._shared(self.ranges, wp.float32)
        rovers.contact = self._shared(self.contact.view(count), wp.bool)
        rovers.visible = self._shared(self._visible, wp.float32)
        self.rovers = rovers
        ones = torch.ones(count, device=device)
        self.set_dynamics(torch.ones(count, dtype=torch.bool, device=device), Dynamics(ones, ones, ones))

    def set_dynamics(self, mask: Tensor, dynamics: Dynamics) -> None:
        """Sets the dynamics of the rovers of ``mask``.

        A changed mass moves the center of mass: the stored positions are valid again after the next placement.
        """
        mass, center, inertia = self._model.total(self._model.chassis_mass * dynamics.chassis_mass.double())
        parameters = (
            (self._mass, mass),
            (self._center, center),
            (self._inertia, inertia),
            (self._inverse_inertia, _inverse(inertia)),
            (self._friction_scale, dynamics.friction),
            (self._motor_torque, self._wheel_torque * dynamics.motor_torque),
        )
        for values, new in parameters:
            rows = mask.reshape(-1, *[1] * (new.ndim - 1))
            values.copy_(torch.where(rows, new.to(values.dtype), values))

    def clear_scans(self) -> None:
        """Clears the scans of the rovers that scan, for a launch with several threads per rover."""
        self.ranges.masked_fill_(self.scanned[:, None], torch.inf)
        self._visible.fill_(self._lidar_range)

    def _zeros(self, *shape: int) -> Tensor:
        return torch.zeros(shape, device=self._device)

    def _shared(self, tensor: Tensor, dtype: type) -> wp.array:
        return wp.from_torch(tensor, dtype=dtype)


def _inverse(matrices: Tensor) -> Tensor:
    """Inverses of matrices ``[N, 3, 3]``, by cross products of their rows.

    The result of a row does not depend on the other rows, to the last bit.
    """
    a, b, c = matrices.unbind(-2)
    columns = torch.stack((torch.linalg.cross(b, c), torch.linalg.cross(c, a), torch.linalg.cross(a, b)), -1)
    return columns / (a * columns[..., 0]).sum(-1)[:, None, None]
