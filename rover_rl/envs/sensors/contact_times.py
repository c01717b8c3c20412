"""ContactTimes: how long the rover can steer for each of some speeds and yaw rates until it touches something."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from rover_rl.envs.config import SCAN_POSE
from rover_rl.envs.seen_map.scans import reading_directions
from rover_rl.envs.sensors.base import Sensor, SensorInput, SensorSetup
from rover_rl.envs.sensors.movers import NUMBERS, SLACK, movers_of
from rover_rl.envs.sensors.suite import CONTACT_TIMES, MOVERS
from rover_rl.envs.specs import Bounds
from rover_rl.robots import Robot
from rover_rl.robots.footprint import covering_discs
from rover_rl.robots.turning import estimated_yaw_gain

SPEEDS, TURNS = 5, 11  # numbers of speeds, from full speed backward to full speed ahead, and of yaw rates
STEP, STEPS = 0.2, 12  # time step, s, and number of steps of a drive
LONGEST = 2.6  # time where nothing is touched, s
YAW_RATE = 1.6  # largest yaw rate of the body, or less if the robot turns no faster, rad/s
EXCESS, MARGIN = 0.04, 0.015  # distances by which discs exceed the body, m


@dataclass(frozen=True, kw_only=True)
class ContactTimes(Sensor):
    """Times until the body touches something, for 5 speeds and 11 yaw rates that the rover steers for, ``[N, 55]``, s.

    The rover accelerates within its limits. What the lidar sees stays where it is, as seen from the known pose if scans
    can be late (entry ``scan_pose``), and where the observation has the entry ``movers``, these keep their velocity. A
    time is a multiple of 0.2 s, and 2.6 s without a contact. All yaw rates of a speed follow one another, from right to
    left.

    A network that reads them need not learn the geometry of the body (U. Patel et al., "DWA-RL: dynamically feasible
    deep reinforcement learning policy for robot navigation among mobile obstacles", ICRA 2021).

    Example:
        >>> env = RoverEnv(world_n="maze", num_envs=2, seed=0, sensors=["contact_times"])
        >>> env.reset()["contact_times"].shape
        torch.Size([2, 55])
    """

    name: str = CONTACT_TIMES
    clips = False
    delayed = None
    takes_long = True
    bounds = Bounds((0.0,) * SPEEDS * TURNS, (LONGEST,) * SPEEDS * TURNS)

    def reader(self, setup: SensorSetup) -> Callable[[SensorInput], Tensor]:
        return _Reader(self, setup)

    def mirror(self, value: Tensor) -> Tensor:
        """Mirrors the yaw rates of each speed."""
        return value.unflatten(-1, (SPEEDS, TURNS)).flip(-1).flatten(-2)


class _Reader:
    def __init__(self, sensor: ContactTimes, setup: SensorSetup) -> None:
        self._fleet, self._period, device = setup.fleet, sensor.period, setup.fleet.index.device
        self._robots, self._mounts = setup.fleet.table(_numbers), setup.fleet.table(lambda each: each.lidar_position)
        self._directions = reading_directions(setup.lidar).to(device)
        self._farthest = setup.lidar.max_range - 1e-3
        self._times = torch.full((len(setup.fleet), SPEEDS * TURNS), LONGEST, device=device)

    def __call__(self, inputs: SensorInput) -> Tensor:
        # Importing NVIDIA Warp takes half a second.
        from rover_rl.envs.sensors.contact_times_kernels import Drives, Scene, measure
        from rover_rl.native.warp import launch_rows, wp

        read, scene, drives = inputs.observation, Scene(), Drives()
        drives.speeds, drives.turns, drives.step, drives.steps, drives.longest = SPEEDS, TURNS, STEP, STEPS, LONGEST
        lidar, velocities = read["lidar"].contiguous(), read["velocities"].contiguous()
        movers = movers_of(read[MOVERS]) if MOVERS in read else lidar.new_zeros(len(lidar), 0, NUMBERS)
        scan_poses = read[SCAN_POSE].contiguous() if SCAN_POSE in read else lidar.new_zeros(len(lidar), 6)
        points = lidar.new_empty(*lidar.shape, 2)
        scene.ranges, scene.farthest, scene.slack = wp.from_torch(lidar), self._farthest, SLACK
        scene.movers, scene.scan_poses = wp.from_torch(movers), wp.from_torch(scan_poses)
        scene.directions, scene.points = (wp.from_torch(part, dtype=wp.vec2) for part in (self._directions, points))
        self._times = self._times.clone()
        mounts = wp.from_torch(self._mounts[:, :2].contiguous(), dtype=wp.vec2)
        given = self._robots, self._fleet.index, mounts, velocities, inputs.due(self._period), self._times
        arrays = [wp.from_torch(part) if isinstance(part, Tensor) else part for part in given]
        launch_rows(measure, lidar.shape[:1], [scene, drives, *arrays], lidar.device)
        return self._times


def _numbers(robot: Robot) -> list[float]:
    centers, radius = covering_discs(robot, EXCESS)
    drive, gain = robot.drive, estimated_yaw_gain(robot)
    turns = min(YAW_RATE, gain * drive.fastest_turn(robot.wheels)), drive.max_angular_acceleration * gain
    body = float(np.abs(centers).max()), float(len(centers) > 2), radius + MARGIN
    return [*body, drive.max_speed, drive.max_linear_acceleration, *turns, drive.min_radius(robot.wheels), gain]
