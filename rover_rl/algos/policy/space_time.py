"""``SpaceTimePlanner``: plans among what moves, for a batch of rows.

A plan tells, for a point that moves at full speed in any direction, how long it takes to the goal from each place
around the rover at each of 40 instants, when movers are where they will be then: by dynamic programming backward in
time, on a grid of 0.2 m and 0.25 s, or less for a robot that is faster than 1 m/s. What comes later is the shortest
path on the map.

A decision simulates drives of 2.2 s: a speed and a yaw rate for 0.7 s, and others for 1.5 s, with the robot's limits of
acceleration, and the discs that cover it among the movers. The action is the beginning of the drive that takes least
time, including that of the plan from its end.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from rover_rl.algos.policy.dwa import EXCESS, MAX_YAW_RATE
from rover_rl.envs.config import HeadingGains
from rover_rl.robots import Robot
from rover_rl.robots.footprint import covering_discs, footprint

LAYER_DT = 0.25  # largest time from one instant of a plan to the next, s
LAYER_WAY = 0.25  # largest way from one instant of a plan to the next, m
HEADINGS = 16  # number of directions in which a point moves in a plan
BLOCKED = 0.26  # least distance of the center from an obstacle below which a cell is blocked, m
MARGIN = 0.015  # distance added to the discs that cover the robot, m
INSIDE = 0.9  # part of the goal's radius that counts as the goal in a plan


class Plans(NamedTuple):
    """Plans of all rows.

    Attributes:
        costs: costs to go at each instant in the cells of a window, ``[N, LAYERS + 1, SIZE * SIZE]``, s.
        origin: x and y of the first cell, ``[N, 2]``, m.
        goal: goals, ``[N, 2]``, m.
    """

    costs: Tensor
    origin: Tensor
    goal: Tensor

    @classmethod
    def empty(cls, rows: int, device: torch.device) -> Plans:
        """Returns plans without costs."""
        from rover_rl.algos.policy.space_time_kernels import LAYERS, SIZE

        pair = torch.zeros(rows, 2, device=device)
        return cls(torch.zeros(rows, int(LAYERS) + 1, int(SIZE) ** 2, device=device), pair, pair)


class SpaceTimePlanner:
    """Planner of a robot: see the module ``space_time``.

    Args:
        robot: robot whose footprint and limits are used.
        yaw_gain: yaw rate of the body relative to that of the wheel odometry.
        speed: largest speed, m/s.
        goal_radius: distance from the goal at which it is reached, m.
    """

    def __init__(self, robot: Robot, yaw_gain: float, speed: float, goal_radius: float) -> None:
        self._robot, self._gain, self.speed, self._goal_radius = robot, yaw_gain, speed, goal_radius
        self._blocked = max(BLOCKED, footprint(robot).half_width + MARGIN)

    @property
    def layer_dt(self) -> float:
        """Time from one instant of a plan to the next, in which a rover moves ``LAYER_WAY`` at most, s.

        With a longer way, it would leave the window within a plan, and it would not matter when it starts.
        """
        return min(LAYER_DT, LAYER_WAY / self.speed)

    @property
    def plan_instants(self) -> list[float]:
        """Instants of a plan at which movers matter, s."""
        from rover_rl.algos.policy.space_time_kernels import LAYERS

        return [layer * self.layer_dt for layer in range(int(LAYERS))]

    @property
    def drive_instants(self) -> list[float]:
        """Instants of a drive at which movers matter, s."""
        from rover_rl.algos.policy.space_time_kernels import DRIVE_DT, FIRST, SECOND

        return [number * float(DRIVE_DT) for number in range(int(FIRST) + int(SECOND) + 1)]

    def begin(self, plans: Plans, rows: Tensor, fixed: Any) -> None:
        """Sets the last costs of ``rows``, int64 ``[n]``, to those of the shortest paths among what does not move."""
        from rover_rl.algos.policy.space_time_kernels import fixed_costs

        inputs = [rows, _pairs(plans.origin), _pairs(plans.goal), self.speed, self._blocked, fixed, plans.costs]
        _launch(fixed_costs, (len(rows),), inputs, rows.device)

    def plan(self, plans: Plans, rows: Tensor, fixed: Any, moving: Any) -> None:
        """Computes the costs of ``rows``, int64 ``[n]``, from the last ones backward in time."""
        from rover_rl.algos.policy.space_time_kernels import LAYERS, SIZE, sweep

        angle = torch.arange(HEADINGS, device=rows.device) * (2 * math.pi / HEADINGS)
        steps = self.speed * self.layer_dt * torch.stack((angle.cos(), angle.sin()), -1)
        inputs = [_pairs(plans.origin), _pairs(plans.goal), INSIDE * self._goal_radius, self.layer_dt, _pairs(steps)]
        inputs += [self._blocked, fixed, moving, plans.costs]
        for layer in reversed(range(int(LAYERS))):
            _launch(sweep, (len(rows), int(SIZE) ** 2), [rows, layer, *inputs], rows.device)

    def decide(
        self, plans: Plans, rows: Tensor, since: Tensor, place: Tensor, velocities: Tensor, fixed: Any, moving: Any
    ) -> Tensor:
        """Returns the actions, ``[N, 2]``: those of ``rows``, int64 ``[n]``, count.

        Args:
            plans: plans.
            rows: rows that decide.
            since: time since the beginning of each row's plan, ``[N]``, s.
            place: x, y (m) and heading (rad) of the rovers, ``[N, 3]``.
            velocities: forward speed (m/s) and yaw rate of the wheels, ``[N, 2]``.
            fixed, moving: what does not move, and movers at :attr:`drive_instants`.
        """
        from rover_rl.algos.policy.space_time_kernels import SPEEDS, TURNS, drive

        turns, speeds = int(TURNS), int(SPEEDS)
        states = torch.cat((place, velocities[:, :1], velocities[:, 1:] * self._gain), -1).contiguous()
        results = torch.zeros(len(states), speeds * turns, device=rows.device)
        inputs = [rows, since, self.layer_dt, states, _pairs(plans.origin), _pairs(plans.goal)]
        inputs += [0.97 * self._goal_radius, self._body(), fixed, moving, plans.costs, results]
        _launch(drive, (len(rows), speeds * turns), inputs, rows.device)
        best = results.argmin(-1)
        speed = self.speed * (2 * (best // turns) / (speeds - 1) - 1)
        yaw_rate = MAX_YAW_RATE * (2 * (best % turns) / (turns - 1) - 1)
        # The heading PID commands the wheels to turn at kp times a constant heading offset.
        offset = (yaw_rate / (self._gain * HeadingGains.kp)).clamp(-math.pi, math.pi)
        return torch.stack((speed, offset), -1)

    def _body(self) -> Any:
        """Returns what a drive depends on of the robot, as the kernels read it."""
        from rover_rl.algos.policy.space_time_kernels import Body

        body, drive = Body(), self._robot.drive
        centers, radius = covering_discs(self._robot, EXCESS)
        # Two discs, or those at the ends of more.
        body.front, body.radius = float(np.abs(centers).max()), radius + MARGIN
        body.speed, body.acceleration = self.speed, drive.max_linear_acceleration
        body.yaw_acceleration, body.yaw_rate = drive.max_angular_acceleration * self._gain, MAX_YAW_RATE
        body.turning = drive.min_radius(self._robot.wheels)
        return body


def window(center: Tensor) -> tuple[Tensor, Tensor]:
    """Returns the first cells of windows around places ``[N, 2]``, and the offsets of all cells, ``[cells, 2]``, m."""
    from rover_rl.algos.policy.space_time_kernels import CELL, SIZE

    size, cell = int(SIZE), float(CELL)
    grid = torch.arange(size, device=center.device) * cell
    return center - size // 2 * cell, torch.stack((grid.repeat(size), grid.repeat_interleave(size)), -1)


def moving_struct(places: list[Tensor], yaw: list[Tensor], form: Tensor) -> Any:
    """Returns where movers will be, as the kernels read it.

    Args:
        places: x and y at each instant, ``[N, M, 2]`` each, m.
        yaw: headings at each instant, ``[N, M]`` each, rad.
        form: half the length and width of boxes, and the radius of other movers, ``[N, M, 3]``, m. Those without any
            do not exist, and are last.
    """
    from rover_rl.algos.policy.space_time_kernels import Moving
    from rover_rl.native.warp import wp

    poses = [
        torch.cat((place, angle.cos()[..., None], angle.sin()[..., None]), -1)
        for place, angle in zip(places, yaw, strict=True)
    ]
    moving = Moving()
    moving.pose = wp.from_torch(torch.stack(poses, 1).float().contiguous(), dtype=wp.vec4)
    moving.form = wp.from_torch(form.contiguous(), dtype=wp.vec3)
    return moving


def fixed_struct(grid: Tensor, frames: Tensor, clearance: Tensor) -> Any:
    """Returns distances to what does not move, as the kernels read them.

    Args:
        grid: number of the grid of each row, int64 ``[N]``.
        frames: x and y of the first point of a grid, spacing (m), and numbers of its rows and columns, ``[G, 5]``.
        clearance: distances, row by row, ``[G, points]``, m.
    """
    from rover_rl.algos.policy.space_time_kernels import Fixed
    from rover_rl.native.warp import wp

    fixed = Fixed()
    fixed.world, fixed.frame = wp.from_torch(grid), wp.from_torch(frames)
    fixed.clearance = wp.from_torch(clearance)
    return fixed


def _pairs(values: Tensor) -> Any:
    from rover_rl.native.warp import wp

    return wp.from_torch(values.float().contiguous(), dtype=wp.vec2)


def _launch(kernel: Any, dim: tuple[int, ...], inputs: list[Any], device: torch.device) -> None:
    """Launches a kernel, in Torch's stream on a GPU."""
    from rover_rl.native.warp import stream_of, wp

    stream = stream_of(device) if device.type == "cuda" else None
    wp.launch(kernel, dim, inputs, device=wp.device_from_torch(device), stream=stream)
