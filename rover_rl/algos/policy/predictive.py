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
from concurrent.futures import ThreadPoolExecutor
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
from rover_rl.envs.seen_map.scans import SIZE, goal_positions
from rover_rl.envs.sensors.movers import movers_in_world
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
ROWS_PER_THREAD = 4  # least number of rows for which a thread of the CPU pays


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
        self._discs, self._radius = covering_discs(self._robot, EXCESS)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        rows, on_gpu = len(tensordict), tensordict["pose"].device.type != "cpu"
        threads = 1 if on_gpu else max(1, min(torch.get_num_threads(), rows // ROWS_PER_THREAD))
        if threads == 1:
            return tensordict.set("action", self._decide(tensordict))
        with ThreadPoolExecutor(threads) as pool:
            return tensordict.set("action", torch.cat([*pool.map(self._decide, tensordict.chunk(threads))]))

    def _decide(self, tensordict: TensorDictBase) -> Tensor:
        # Importing NVIDIA Warp takes half a second.
        from rover_rl.algos.policy import predictive_kernels as kernels
        from rover_rl.native.warp import launch_options, wp

        pose, imu, _, velocities = (tensordict[key] for key in self.in_keys[:4])
        count, options, layers = len(pose), launch_options(pose.device), int(kernels.LAYERS)
        movers, plans = self._movers(tensordict), self._plans(tensordict)
        around = self._around(tensordict, movers, layers, self._dt)
        wp.launch(kernels.fixed_costs, count, [around, plans], **options)
        way, inner = self._speed * self._dt / float(kernels.CELL), int(kernels.SIZE - 2 * kernels.BORDER)
        if pose.device.type == "cpu":
            wp.launch(kernels.sweep, (count, 1, 1), [layers - 1, plans.first, way, around, plans, 1, 1], **options)
        else:
            parts = math.ceil(inner / int(kernels.LANES))
            for layer in reversed(range(plans.first, layers)):
                inputs = [layer, layer, way, around, plans, inner, parts]
                wp.launch(kernels.sweep, (count, inner, parts), inputs, **options)
        around = self._around(tensordict, movers, int(kernels.FIRST + kernels.SECOND) + 1, float(kernels.DRIVE_DT))
        plans.goal_radius = DRIVEN * GOAL_RADIUS
        states = torch.cat((pose[:, :2], imu[:, 2:], velocities[:, :1], velocities[:, 1:] * self._gain), -1)
        turns, speeds = int(kernels.TURNS), int(kernels.SPEEDS)
        results = pose.new_full((count, speeds * turns), math.inf)
        drives = [states.contiguous(), self._body(), around, plans, results.amin(-1), results]
        wp.launch(kernels.drive, (count, speeds * turns), drives, **options)
        best = results.argmin(-1)
        speed = self._speed * (2 * (best // turns) / (speeds - 1) - 1)
        yaw_rate = MAX_YAW_RATE * (2 * (best % turns) / (turns - 1) - 1)
        # The heading PID commands the wheels to turn at kp times a constant heading offset.
        offset = (yaw_rate / (self._gain * HeadingGains.kp)).clamp(-math.pi, math.pi)
        return torch.stack((speed, offset), -1).to(pose)

    def _plans(self, tensordict: TensorDictBase) -> Any:
        """Returns plans that have not been made yet."""
        from rover_rl.algos.policy import predictive_kernels as kernels
        from rover_rl.native.warp import wp

        pose, imu, target = (tensordict[key] for key in self.in_keys[:3])
        plans, cells, cell = kernels.Plans(), int(kernels.SIZE), float(kernels.CELL)
        plans.origins = _pairs(pose[:, :2] - cells // 2 * cell)
        plans.goals = _pairs(goal_positions(pose, imu, *target.split(1, -1)))
        plans.goal_radius, plans.dt, plans.speed = PLANNED * GOAL_RADIUS, self._dt, self._speed
        plans.blocked = max(BLOCKED, self._robot.footprint.half_width + MARGIN)
        drive = int(kernels.FIRST + kernels.SECOND) * float(kernels.DRIVE_DT)
        plans.first = min(int(drive / self._dt + 0.5), int(kernels.LAYERS))
        angle = torch.arange(HEADINGS, device=pose.device) * (2 * math.pi / HEADINGS)
        ways = self._speed * self._dt / cell * torch.stack((angle.cos(), angle.sin()), -1)
        (i, j), (s, t) = ways.floor().int().unbind(-1), (ways - ways.floor()).unbind(-1)
        shares = torch.stack(((1 - s) * (1 - t), s * (1 - t), (1 - s) * t, s * t), -1)
        plans.steps, plans.shares = wp.from_torch(i + j * cells), wp.from_torch(shares, dtype=wp.vec4)
        memory = pose.new_empty(5, len(pose), cells**2)
        plans.costs = wp.from_torch(memory[:2].reshape(len(pose), 2, cells**2))
        plans.fixed, plans.clearance, plans.ahead = (wp.from_torch(part) for part in memory[2:])
        return plans

    def _movers(self, tensordict: TensorDictBase) -> tuple[Tensor, Tensor, Tensor]:
        """Returns positions and velocities in the world and radii of movers. Those that exist are first."""
        movers = movers_in_world(*(tensordict[key] for key in (MOVERS, "pose", "imu")))
        order = (movers[..., 4] == 0).to(torch.int8).sort(dim=-1, stable=True).indices
        place, velocity, radius = movers.gather(1, order[..., None].expand_as(movers)).split((2, 2, 1), -1)
        return place, velocity, radius[..., 0].contiguous()

    def _around(self, tensordict: TensorDictBase, movers: tuple[Tensor, Tensor, Tensor], count: int, dt: float) -> Any:
        """Returns what is around the rovers as the kernels read it, with movers at ``count`` instants from now on."""
        from rover_rl.algos.policy.predictive_kernels import Around
        from rover_rl.native.warp import wp

        place, velocity, radius = movers
        distances, frame = tensordict[SEEN_DISTANCES].split((SIZE**2, 3), -1)
        around = Around()
        around.frame, around.side = wp.from_torch(frame.contiguous(), dtype=wp.vec3), SIZE
        around.clearance, around.radius = wp.from_torch(distances), wp.from_torch(radius)
        times = (torch.arange(count, device=place.device) * dt)[:, None, None]
        around.places = _pairs(place[:, None] + times * velocity[:, None])
        return around

    def _body(self) -> Any:
        from rover_rl.algos.policy.predictive_kernels import Body

        body, drive = Body(), self._robot.drive
        # Two discs, or those at the ends of more.
        body.front, body.radius = float(np.abs(self._discs).max()), self._radius + MARGIN
        body.speed, body.acceleration = self._speed, drive.max_linear_acceleration
        body.yaw_acceleration, body.yaw_rate = drive.max_angular_acceleration * self._gain, MAX_YAW_RATE
        body.turning = drive.min_radius(self._robot.wheels)
        return body


def _pairs(values: Tensor) -> Any:
    from rover_rl.native.warp import wp

    return wp.from_torch(values.float().contiguous(), dtype=wp.vec2)
