"""``PredictivePolicy``: planner in space and time, among what the lidar sees at rest and moving.

A plan tells, for a point that moves at full speed in any direction, how long it takes to the goal from each place
around the rover at each of 40 instants, when movers are where they will be then: by dynamic programming backward in
time, on a grid of 0.2 m and 0.25 s, or less for a robot that is faster than 1 m/s. What comes later is the shortest
path on the map.

A decision simulates drives of 2.2 s: a speed and a yaw rate for 0.7 s, and others for 1.5 s, with the robot's limits of
acceleration, and the discs that cover it among the movers. The action is the beginning of the drive that takes least
time, including that of the plan from its end.

Example:
    >>> policy = PredictivePolicy()
    >>> env = make_env(sensors_for(policy, replace(policy.made_for, world="plaza", num_envs=2, backend="warp")))
    >>> PolicyRunner(policy)(env.reset()).shape
    torch.Size([2, 2])
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from rover_rl.algos.policy.dwa import EXCESS, MAX_YAW_RATE
from rover_rl.algos.policy.grid_planner import beams_and_contacts
from rover_rl.envs.actions import action_bounds
from rover_rl.envs.config import HeadingGains, RobotLike
from rover_rl.envs.seen_map.scans import SIZE, goal_positions, in_world
from rover_rl.envs.sensors.movers import movers_of
from rover_rl.envs.sensors.suite import MOVERS, SEEN_DISTANCES
from rover_rl.robots import get_robot
from rover_rl.robots.footprint import covering_discs
from rover_rl.robots.turning import estimated_yaw_gain

GOAL_RADIUS = 0.3  # distance from the goal that it drives to, m
PLANNED, DRIVEN = 0.9, 0.97  # parts of this distance that count as the goal in a plan, and in a drive
LAYER_DT = 0.25  # largest time from one instant of a plan to the next, s
# Largest way from one instant of a plan to the next, m. With a longer one, a rover would leave the window in a plan,
# and it would not matter when it starts.
LAYER_WAY = 0.25
HEADINGS = 16  # number of directions in which a point moves in a plan
BLOCKED = 0.26  # least distance of the center from an obstacle below which a cell is blocked, m
MARGIN = 0.015  # distance added to the discs that cover the robot, m


class PredictivePolicy(TensorDictModuleBase):
    """Plans ways around what moves, each at the time at which the rover is there.

    It plans ten times a second, on the map of what the lidar has seen. What moves is taken to keep its velocity.

    The policy reads ``pose``, ``imu``, ``target``, ``velocities``, ``movers`` and ``seen_distances``.

    ``made_for`` is the environment that it drives in, with one lidar reading for each beam, and episodes that end when
    the body touches an obstacle. ``yaw_gain`` is the yaw rate of the body relative to that of the wheel odometry;
    ``None``: an estimate from the drive.
    """

    trained_action_repeat = 2
    row_by_row = True

    def __init__(self, robot: RobotLike = "rover_zero", yaw_gain: float | None = None) -> None:
        super().__init__()
        self.made_for, self._robot = beams_and_contacts(robot), get_robot(robot)
        self.in_keys, self.out_keys = ["pose", "imu", "target", "velocities", MOVERS, SEEN_DISTANCES], ["action"]
        self._gain = estimated_yaw_gain(self._robot) if yaw_gain is None else yaw_gain
        self._speed = min(self._robot.drive.max_speed, action_bounds(self.made_for.bounded_action).high[0])
        self._dt = min(LAYER_DT, LAYER_WAY / self._speed)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        # Importing NVIDIA Warp takes half a second.
        from rover_rl.algos.policy import predictive_kernels as kernels
        from rover_rl.native.warp import launch_options, wp

        pose, imu, target, velocities = (tensordict[key] for key in self.in_keys[:4])
        (count, _), options, cells = pose.shape, launch_options(pose.device), int(kernels.SIZE)
        plans = kernels.Plans()
        plans.origins = _pairs(pose[:, :2] - cells // 2 * float(kernels.CELL))
        plans.goals = _pairs(goal_positions(pose, imu, *target.split(1, -1)))
        plans.goal_radius, plans.dt, plans.speed = PLANNED * GOAL_RADIUS, self._dt, self._speed
        plans.blocked = max(BLOCKED, self._robot.footprint.half_width + MARGIN)
        plans.costs = wp.from_torch(pose.new_zeros(count, int(kernels.LAYERS) + 1, cells**2))
        instants = [layer * self._dt for layer in range(int(kernels.LAYERS))]
        around = self._around(tensordict, instants)
        wp.launch(kernels.fixed_costs, count, [around, plans], **options)
        angle = torch.arange(HEADINGS, device=pose.device) * (2 * math.pi / HEADINGS)
        steps = _pairs(self._speed * self._dt * torch.stack((angle.cos(), angle.sin()), -1))
        for layer in reversed(range(int(kernels.LAYERS))):
            wp.launch(kernels.sweep, (count, cells**2), [layer, steps, around, plans], **options)
        turns, speeds = int(kernels.TURNS), int(kernels.SPEEDS)
        instants = [n * float(kernels.DRIVE_DT) for n in range(int(kernels.FIRST + kernels.SECOND) + 1)]
        around = self._around(tensordict, instants)
        plans.goal_radius = DRIVEN * GOAL_RADIUS
        states = torch.cat((pose[:, :2], imu[:, 2:], velocities[:, :1], velocities[:, 1:] * self._gain), -1)
        results = pose.new_zeros(count, speeds * turns)
        drives = [states.contiguous(), self._body(), around, plans, results]
        wp.launch(kernels.drive, (count, speeds * turns), drives, **options)
        best = results.argmin(-1)
        speed = self._speed * (2 * (best // turns) / (speeds - 1) - 1)
        yaw_rate = MAX_YAW_RATE * (2 * (best % turns) / (turns - 1) - 1)
        # The heading PID commands the wheels to turn at kp times a constant heading offset.
        offset = (yaw_rate / (self._gain * HeadingGains.kp)).clamp(-math.pi, math.pi)
        return tensordict.set("action", torch.stack((speed, offset), -1).to(pose))

    def _around(self, tensordict: TensorDictBase, instants: list[float]) -> Any:
        """Returns what is around the rovers, with movers at some times from now (s), as the kernels read it."""
        from rover_rl.algos.policy.predictive_kernels import Around
        from rover_rl.native.warp import wp

        movers, pose, imu = movers_of(tensordict[MOVERS]), tensordict["pose"], tensordict["imu"]
        # Those that exist first, as the kernels read no others.
        order = (movers[..., 4] == 0).to(torch.int8).sort(dim=-1, stable=True).indices
        movers = movers.gather(1, order[..., None].expand_as(movers))
        place, velocity = (in_world(movers[..., k : k + 2], imu) for k in (0, 2))
        place = pose[:, None, :2] + place
        distances, frame = tensordict[SEEN_DISTANCES].split((SIZE**2, 3), -1)
        around = Around()
        around.frame, around.side = wp.from_torch(frame.contiguous(), dtype=wp.vec3), SIZE
        around.clearance, around.radius = (wp.from_torch(each.contiguous()) for each in (distances, movers[..., 4]))
        around.places = _pairs(torch.stack([place + time * velocity for time in instants], 1))
        return around

    def _body(self) -> Any:
        from rover_rl.algos.policy.predictive_kernels import Body

        body, drive = Body(), self._robot.drive
        centers, radius = covering_discs(self._robot, EXCESS)
        # Two discs, or those at the ends of more.
        body.front, body.radius = float(np.abs(centers).max()), radius + MARGIN
        body.speed, body.acceleration = self._speed, drive.max_linear_acceleration
        body.yaw_acceleration, body.yaw_rate = drive.max_angular_acceleration * self._gain, MAX_YAW_RATE
        body.turning = drive.min_radius(self._robot.wheels)
        return body


def _pairs(values: Tensor) -> Any:
    from rover_rl.native.warp import wp

    return wp.from_torch(values.float().contiguous(), dtype=wp.vec2)
