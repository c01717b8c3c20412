"""Robot: what a policy needs to know of the robot that it drives."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import torch
from torch import Tensor

from rover_rl.envs.sensors.base import Sensor, SensorInput, SensorSetup
from rover_rl.envs.specs import Bounds
from rover_rl.robots import Robot
from rover_rl.robots.turning import yaw_gain

TYPICAL = (0.3, 0.3, 0.3, 1.0, 3.0, 0.5, 0.2, 1.0, 0.2, 0.2, 0.4, 2 * math.pi)
"""Values that networks read as 1, or -1."""


class RobotNumbers(NamedTuple):
    """Values of the sensor, ``[..., 1]`` each: see :class:`RobotBody`."""

    behind: Tensor
    ahead: Tensor
    half_width: Tensor
    max_speed: Tensor
    max_yaw_rate: Tensor
    min_radius: Tensor
    pivot: Tensor
    yaw_gain: Tensor
    lidar_x: Tensor
    lidar_y: Tensor
    lidar_z: Tensor
    lidar_view: Tensor

    @classmethod
    def of(cls, values: Tensor) -> RobotNumbers:
        """Returns the columns of values ``[..., 12]``."""
        return cls(*values.split(1, -1))

    @classmethod
    def of_robot(cls, robot: Robot, rows: Tensor) -> RobotNumbers:
        """Returns those of one robot for each of ``rows [..., n]``."""
        return cls.of(rows.new_tensor(_numbers(robot)).expand(*rows.shape[:-1], -1))


@dataclass(frozen=True, kw_only=True)
class RobotBody(Sensor):
    """Size and limits of the robot, ``[N, 12]``, so that one policy can drive different robots.

    Reach of the footprint behind and ahead of the origin and half its width (m), largest speed (m/s) and yaw rate
    (rad/s), smallest radius of a turn (m; 0 for a robot that turns in place), x of the line on which the centers of its
    turns lie (m), yaw rate of the body relative to that of its wheels, which slip, position of the lidar (m), and the
    angle that it sees (rad).

    Example:
        >>> env = RoverEnv(num_envs=2, seed=0, sensors=["robot"])
        >>> env.reset()["robot"][0, :3]
        tensor([0.2670, 0.2635, 0.2250])
    """

    name: str = "robot"
    delayed = None
    mirror_signs = (*(1.0 for _ in range(9)), -1.0, 1.0, 1.0)
    bounds = Bounds(
        (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, -5.0, 0.0, -5.0, -5.0, 0.0, 0.0),
        (5.0, 5.0, 5.0, 20.0, 20.0, 50.0, 5.0, 10.0, 5.0, 5.0, 5.0, 7.0),
    )

    def reader(self, setup: SensorSetup) -> Callable[[SensorInput], Tensor]:
        fleet, table = setup.fleet, robot_table(setup.fleet.robots).to(setup.fleet.index.device)
        return lambda inputs: table[fleet.index]

    def encode(self, value: Tensor) -> Tensor:
        """Returns the value in units of :data:`TYPICAL`."""
        return value / torch.tensor(TYPICAL, device=value.device)


def robot_table(robots: Sequence[Robot]) -> Tensor:
    """Returns the values of the sensor ``robot`` for robots, ``[K, 12]``."""
    return torch.tensor([_numbers(robot) for robot in robots])


@lru_cache(maxsize=1024)
def _numbers(robot: Robot) -> list[float]:
    outline, drive = robot.footprint, robot.drive
    size = [-outline.back, outline.front, outline.half_width]
    limits = [drive.max_speed, drive.fastest_turn(robot.wheels), drive.min_radius(robot.wheels)]
    return [*size, *limits, drive.pivot(robot.wheels), yaw_gain(robot), *robot.lidar_position, robot.lidar_view]
