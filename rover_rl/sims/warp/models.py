"""Conversion of robots to the structs that the kernels take."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch

from rover_rl.native.warp import wp
from rover_rl.robots import Robot
from rover_rl.robots.fleet import Fleet, MassTable
from rover_rl.sims.warp.kernels.types import MAX_WHEELS, RobotModel

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
