"""State of all rovers in memory shared by torch and Warp."""

from __future__ import annotations

from collections.abc import Collection
from functools import partial

import torch
from torch import Tensor

from rover_rl.native.warp import wp
from rover_rl.robots.fleet import Fleet, MassTable
from rover_rl.sims.rover_state import Dynamics, Force, no_forces
from rover_rl.sims.warp.kernels.types import RoverArrays


class StateBuffers:
    """State and parameters of all rovers, a row each. Torch tensors and Warp arrays share the same memory.

    Robots with fewer wheels, motors or steering joints than others leave columns unused.

    Attributes:
        rovers: Warp arrays for the kernels, which ``types.py`` describes.
        tensors: the same memory by the names of these arrays.
        poses: planar poses of the base frames for the next placement: x, y (m) and yaw (rad), ``[N, 3]``.
        reports: fields that have been asked for.
    """

    def __init__(self, fleet: Fleet) -> None:
        count, device = len(fleet), fleet.index.device
        self._fleet, self._masses = fleet, MassTable(fleet.robots, device)
        self._wheel_torque = fleet.table(lambda robot: robot.drive.torque)
        zeros = partial(torch.zeros, device=device)
        wheels = max(len(robot.wheels.hubs) for robot in fleet.robots)
        motors = max(len(robot.drive.motors) for robot in fleet.robots)
        steering = max(len(robot.drive.steering) for robot in fleet.robots)
        flags = partial(zeros, dtype=torch.bool)
        self.poses = zeros(count, 3)
        self._parameters = {
            "mass": zeros(count),
            "center": zeros(count, 3),
            "inertia": zeros(count, 3, 3),
            "inverse_inertia": zeros(count, 3, 3),
            "friction_scale": zeros(count),
            "motor_torque": zeros(count),
        }
        self.tensors = {
            "position": zeros(count, 3),
            "orientation": zeros(count, 4),
            "velocity": zeros(count, 3),
            "angular_velocity": zeros(count, 3),
            "wheel_spins": zeros(count, wheels),
            # Three impulses for each of the two ground contacts of a wheel, and one for its motor.
            "impulses": zeros(count, 7 * wheels),
            **self._parameters,
            "scene": zeros(count, dtype=torch.int32),
            "robot": fleet.index.int(),
            "target_speeds": zeros(count, motors),
            "target_angles": zeros(count, steering),
            "angles": zeros(count, steering),
            "active": flags(count),
            "base_state": zeros(count, 7 + motors + steering),
            "contact": flags(count),
            "mover_contact": flags(count),
        }
        self.reports: dict[str, Tensor] = {}
        self.rovers = self.struct()
        self._nominal = self._parameters_of(torch.arange(len(fleet.robots), device=device))
        self.enter_robots(torch.ones(count, dtype=torch.bool, device=device))

    def struct(self, **scan: Tensor) -> RoverArrays:
        """Returns the struct for the kernels, with the arrays of a scan for the lidar's."""
        rovers, types = RoverArrays(), vars(RoverArrays)["vars"]
        for name, tensor in (self.tensors | scan).items():
            setattr(rovers, name, wp.from_torch(tensor, dtype=types[name].type.dtype))
        return rovers

    def measure(self, fields: Collection[Force]) -> None:
        """Adds arrays for fields that are asked for. They are the kernels' from the next launch that is recorded."""
        count, wheels = self.tensors["wheel_spins"].shape
        empty = no_forces(fields, count, wheels)
        self.reports = {name: torch.from_numpy(values).to(self.poses.device) for name, values in empty.items()}
        self.tensors |= self.reports
        self.rovers = self.struct()

    def enter_robots(self, mask: Tensor) -> None:
        """Gives the rovers of ``mask`` the robots of the fleet's index, with their own dynamics."""
        index = self._fleet.index
        self.tensors["robot"].copy_(index)
        self._change(mask, {name: values[index] for name, values in self._nominal.items()})

    def set_dynamics(self, mask: Tensor, dynamics: Dynamics) -> None:
        """Sets dynamics. A changed mass moves the center of mass: positions are valid after the next placement."""
        self._change(mask, self._parameters_of(self._fleet.index, dynamics))

    def _parameters_of(self, index: Tensor, dynamics: Dynamics | None = None) -> dict[str, Tensor]:
        """Returns the parameters of robots, by their index (int64 ``[M]``), with factors of their dynamics."""
        if dynamics is None:
            ones = torch.ones(len(index), device=index.device)
            dynamics = Dynamics(ones, ones, ones)
        chassis = self._masses.chassis_mass[index] * dynamics.chassis_mass.double()
        mass, center, inertia = self._masses.total(chassis, index)
        return {
            "mass": mass,
            "center": center,
            "inertia": inertia,
            "inverse_inertia": _inverse(inertia),
            "friction_scale": dynamics.friction,
            "motor_torque": self._wheel_torque[index] * dynamics.motor_torque,
        }

    def _change(self, mask: Tensor, changed: dict[str, Tensor]) -> None:
        for name, new in changed.items():
            values, rows = self._parameters[name], mask.reshape(-1, *[1] * (new.ndim - 1))
            values.copy_(torch.where(rows, new.to(values.dtype), values))


def _inverse(matrices: Tensor) -> Tensor:
    """Inverses of matrices ``[N, 3, 3]``, by cross products: one does not depend on the others, to the last bit."""
    a, b, c = matrices.unbind(-2)
    columns = torch.stack((torch.linalg.cross(b, c), torch.linalg.cross(c, a), torch.linalg.cross(a, b)), -1)
    return columns / (a * columns[..., 0]).sum(-1)[:, None, None]
