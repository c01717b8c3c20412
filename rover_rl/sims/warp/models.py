"""Conversion of robots to the structs that the kernels take."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch

from rover_rl.native.warp import wp
from rover_rl.robots import Robot
from rover_rl.robots.fleet import Fleet
from rover_rl.robots.inertial_model import InertialModel
from rover_rl.sims.warp.kernels.types import MAX_WHEELS, RobotModel


def make_robot_model(robot: Robot, inertial_model: InertialModel, device: wp.Device) -> RobotModel:
    """Copies the geometry of a robot to a device. Raises ``ValueError`` for more than :data:`MAX_WHEELS` wheels."""
    wheels = len(inertial_model.hubs)
    if wheels > MAX_WHEELS:
        raise ValueError(f"the warp backend supports at most {MAX_WHEELS} wheels, {robot.name!r} has {wheels}")
    model = RobotModel()
    model.wheels = wheels
    model.motors = len(robot.drive.motors)
    model.motor_of_wheel = wp.array(robot.drive.motor_of_wheel, dtype=int, device=device)
    model.steering_of_wheel = wp.array(robot.wheels.steering or (-1,) * wheels, dtype=int, device=device)
    rollers = [
        wp.vec3() if angle is None else wp.vec3(math.cos(angle), math.sin(angle), 0.0) for angle in robot.drive.rollers
    ]
    model.rollers = wp.array(rollers, dtype=wp.vec3, device=device)
    model.wheel_radius = robot.wheels.radius
    model.wheel_half_width = robot.wheels.width / 2
    model.wheel_inertia = inertial_model.wheel_spin_inertia
    model.hubs = wp.array(inertial_model.hubs, dtype=wp.vec3, device=device)
    model.box_centers = wp.array(inertial_model.box_centers, dtype=wp.vec3, device=device)
    model.box_halves = wp.array(inertial_model.box_halves, dtype=wp.vec3, device=device)
    model.chassis_points = wp.array(inertial_model.points(), dtype=wp.vec3, device=device)
    model.bounding_radius = bounding_radius(robot, inertial_model)
    model.lidar_position = wp.vec3(*robot.lidar_position)
    model.lidar_range = robot.lidar_range
    return model


class ModelTable:
    """Models of the robots of a fleet, by index, in one array.

    Attributes:
        models: model of each robot.
        reach: radius of a sphere around the center of mass that contains any of the rovers, m.
        ranges: maximum range of each robot's lidar, ``[K]``, m.
    """

    def __init__(self, fleet: Fleet, inertial_models: Sequence[InertialModel], device: wp.Device) -> None:
        # A struct in an array refers to other arrays without owning them.
        self._owners = [make_robot_model(*pair, device) for pair in zip(fleet.robots, inertial_models, strict=True)]
        self.models = wp.array(self._owners, dtype=RobotModel, device=device)
        self.reach = max(model.bounding_radius for model in self._owners)
        self.ranges = fleet.table(lambda robot: robot.lidar_range)


def bounding_radius(robot: Robot, model: InertialModel) -> float:
    """Radius (m) of a sphere around the center of mass that contains the whole rover."""
    center = model.total(torch.tensor([model.chassis_mass], dtype=torch.float64))[1][0].numpy()
    wheel = math.hypot(robot.wheels.radius, robot.wheels.width / 2)
    hubs = np.linalg.norm(model.hubs - center, axis=1) + wheel
    boxes = np.linalg.norm(np.abs(model.box_centers - center) + model.box_halves, axis=1)
    # The margin of 1 cm covers the shift of the center of mass, some millimeters, when the chassis mass is randomized.
    return float(np.concatenate((hubs, boxes)).max()) + 0.01
