"""Robots, and the state of all rovers, as the structs that the kernels take."""

from __future__ import annotations

import math
from collections.abc import Collection
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from rover_rl.native.warp import wp
from rover_rl.robots import Robot
from rover_rl.robots.fleet import Fleet, MassTable
from rover_rl.sims.rover_state import Dynamics, Force, no_forces
from rover_rl.sims.warp.kernels.types import MAX_WHEELS, RobotModel, RoverArrays

POINT_SPACING = 0.3
"""Maximum spacing of the sample points of the chassis that are tested against the ground, m."""


def make_robot_model(robot: Robot, device: wp.Device) -> RobotModel:
    """Copies the geometry of a robot to a device. Raises ``ValueError`` for more than :data:`MAX_WHEELS` wheels."""
    wheels = len(robot.wheels.hubs)
    if wheels > MAX_WHEELS:
        raise ValueError(f"the warp backend supports at most {MAX_WHEELS} wheels, {robot.name!r} has {wheels}")
    drive = robot.drive
    centers, halves = (np.array([box[part] for box in robot.boxes]).reshape(-1, 3) / (part + 1) for part in (0, 1))
    arms = [(0.0, 0.0) if angle is None else (math.cos(angle), math.sin(angle)) for angle in drive.rollers]
    model = RobotModel()
    model.wheels, model.motors = wheels, len(drive.motors)
    model.wheel_radius, model.wheel_half_width = robot.wheels.radius, robot.wheels.width / 2
    model.wheel_inertia = robot.wheel.inertia[1][1]
    model.bounding_radius = bounding_radius(robot)
    model.lidar_position, model.lidar_range = wp.vec3(*robot.lidar_position), robot.lidar_range
    model.motor_of_wheel = wp.array(drive.motor_of_wheel, dtype=int, device=device)
    model.steering_of_wheel = wp.array(robot.wheels.steering or (-1,) * wheels, dtype=int, device=device)
    points: dict[str, Any] = {
        "rollers": [(*arm, 0.0) for arm in arms],
        "hubs": robot.wheels.hubs,
        "box_centers": centers,
        "box_halves": halves,
        "chassis_points": chassis_points(centers, halves),
    }
    for name, values in points.items():
        setattr(model, name, wp.array(np.reshape(values, (-1, 3)), dtype=wp.vec3, device=device))
    return model


class ModelTable:
    """Models of the robots of a fleet, by index, in one array.

    Attributes:
        models: model of each robot.
        reach: radius of a sphere around the center of mass that contains any of the rovers, m.
        ranges: maximum range of each robot's lidar, ``[K]``, m.
    """

    def __init__(self, fleet: Fleet, device: wp.Device) -> None:
        # A struct in an array refers to other arrays without owning them.
        self._owners = [make_robot_model(robot, device) for robot in fleet.robots]
        self.models = wp.array(self._owners, dtype=RobotModel, device=device)
        self.reach = max(model.bounding_radius for model in self._owners)
        self.ranges = fleet.table(lambda robot: robot.lidar_range)


def chassis_points(centers: np.ndarray, halves: np.ndarray) -> np.ndarray:
    """Sample points on the top and bottom of boxes ``[B, 3]``, at most :data:`POINT_SPACING` apart, ``[P, 3]``.

    Points inside another box are left out.
    """
    points = [np.zeros((0, 3))]
    for index, (center, half) in enumerate(zip(centers, halves, strict=True)):
        counts = np.maximum(np.ceil(2 * half / POINT_SPACING).astype(int), 1)
        axes = [np.linspace(-side, side, count + 1) for side, count in zip(half, counts, strict=True)]
        grid = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
        # The ground touches the bottom, or the top of a rover that has rolled over.
        own = center + grid[np.abs(grid[:, 2]) > half[2] - 1e-9]
        others = np.delete(centers, index, 0), np.delete(halves, index, 0) + 5e-3
        points.append(own[(np.abs(own[:, None] - others[0]) > others[1]).any(2).all(1)])
    return np.concatenate(points)


def bounding_radius(robot: Robot) -> float:
    """Radius (m) of a sphere around the center of mass that contains the whole rover."""
    masses = MassTable([robot])
    center = masses.total(masses.chassis_mass, torch.zeros(1, dtype=torch.int64))[1][0].numpy()
    wheel = math.hypot(robot.wheels.radius, robot.wheels.width / 2)
    hubs = np.linalg.norm(np.array(robot.wheels.hubs) - center, axis=1) + wheel
    boxes = [np.linalg.norm(np.abs(np.array(box.center) - center) + np.array(box.size) / 2) for box in robot.boxes]
    # The margin of 1 cm covers the shift of the center of mass, some millimeters, when the chassis mass is randomized.
    return float(np.concatenate((hubs, boxes)).max()) + 0.01


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
