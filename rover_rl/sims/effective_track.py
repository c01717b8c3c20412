"""Measures how a skid-steer robot turns: spins it in a simulator."""

from __future__ import annotations

import math

import torch

from rover_rl.robots import Robot
from rover_rl.robots.drives import SkidSteer
from rover_rl.rotations import quaternion_to_euler
from rover_rl.sims.backends import make_simulator
from rover_rl.worlds import Terrain, World

SETTLING, MEASURED = 1.0, 3.0
"""Time to settle, and time of the measurement, s."""
RATE, FASTEST = 0.5, 1.0
"""Yaw rate that is commanded, as a share of the robot's largest one, and its largest value, rad/s."""


def measured_track(robot: Robot, backend: str = "warp") -> float:
    """Measures the effective distance of the left and right wheels by a spin on level ground, m.

    It is the speed of the right wheels minus that of the left ones over the yaw rate. A skid-steer robot whose drive
    has this ``separation`` turns as fast as it is commanded. It does not depend on friction or speed, but on the place
    of the center of mass and on how the ground carries the wheels. Raises ``ValueError`` if the robot has another drive
    than :class:`~rover_rl.robots.drives.SkidSteer`, or does not turn.

    Example:
        >>> from rover_rl.robots import get_robot
        >>> round(measured_track(get_robot("husky")), 2)
        1.04
    """
    drive = robot.drive
    if not isinstance(drive, SkidSteer):
        kind = type(drive).__name__
        raise ValueError(f"only a SkidSteer drive has an effective track, that of {robot.name!r} is {kind}")
    simulator = make_simulator(backend, worlds=[World("level", Terrain.flat((40, 40)))], robot=robot)
    command = torch.tensor([[0.0, min(FASTEST, RATE * drive.max_yaw_rate)]])
    turned = reported = 0.0
    try:
        state = simulator.reset(torch.ones(1, dtype=torch.bool), torch.zeros(1, 3))
        for _ in range(round(SETTLING / simulator.control_dt)):
            state = simulator.step(command)
        for _ in range(round(MEASURED / simulator.control_dt)):
            before, state = state, simulator.step(command)
            start, end = (quaternion_to_euler(one.orientation)[0, 2] for one in (before, state))
            turned += float(torch.remainder(end - start + math.pi, 2 * math.pi) - math.pi)
            reported += float(state.angular_velocity[0, -1]) * simulator.control_dt
    finally:
        simulator.close()
    if not turned > 0.01 * reported:
        raise ValueError(f"robot {robot.name!r} does not turn in {backend}")
    return reported / turned * drive.track(robot.wheels)
