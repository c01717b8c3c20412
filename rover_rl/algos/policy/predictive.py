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
from rover_rl.algos.policy.grid_actions import ACTIONS, nearest_index
from rover_rl.algos.policy.grid_planner import beams_and_contacts
from rover_rl.envs.actions import action_bounds
from rover_rl.envs.config import HeadingGains, RobotLike
from rover_rl.envs.seen_map.scans import SIZE, goal_positions, in_world
from rover_rl.envs.sensors.movers import NUMBERS, movers_in_world
from rover_rl.envs.sensors.suite import MOVERS, SEEN_DISTANCES
from rover_rl.envs.transforms.path_reward import world_of
from rover_rl.robots import get_robot
from rover_rl.robots.footprint import covering_discs
from rover_rl.robots.turning import estimated_yaw_gain
from rover_rl.worlds.clearance import clearance_on_grid
from rover_rl.worlds.world import World, Worlds

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
# Of labels: difference of costs for which a weight is e times smaller, and cost from which on all count alike, s.
TEMPERATURE, WORST = 0.5, 60.0
# Number of points along a side of the grid of distances of a world, the largest distance in it, m, and the number of
# rows whose grids are copied at once.
POINTS, FARTHEST, ROWS_AT_ONCE = 240, 2.0, 256


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
        return tensordict.set("action", self.actions()[self.costs(tensordict).argmin(-1)].to(tensordict["pose"]))

    def actions(self) -> Tensor:
        """Returns the actions that a drive begins with, ``[K, 2]``: forward speed (m/s), heading offset (rad)."""
        from rover_rl.algos.policy import predictive_kernels as kernels

        speeds, turns = (torch.linspace(-1, 1, int(count)) for count in (kernels.SPEEDS, kernels.TURNS))
        # The heading PID commands the wheels to turn at kp times a constant heading offset.
        offsets = MAX_YAW_RATE * turns / (self._gain * HeadingGains.kp)
        return torch.cartesian_prod(self._speed * speeds, offsets.clamp(-math.pi, math.pi))

    def costs(self, tensordict: TensorDictBase) -> Tensor:
        """Returns the least cost of the drives that begin with each action, ``[N, K]``, s: 1000 with a collision."""
        rows, on_gpu = len(tensordict), tensordict["pose"].device.type != "cpu"
        threads = 1 if on_gpu else max(1, min(torch.get_num_threads(), rows // ROWS_PER_THREAD))
        if threads == 1:
            return self._costs(tensordict)
        with ThreadPoolExecutor(threads) as pool:
            return torch.cat([*pool.map(self._costs, tensordict.chunk(threads))])

    def _costs(self, tensordict: TensorDictBase) -> Tensor:
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
        return results

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
        distances, frame, side = self._clearance(tensordict)
        around = Around()
        around.frame, around.side = wp.from_torch(frame.contiguous(), dtype=wp.vec3), side
        around.clearance, around.radius = wp.from_torch(distances), wp.from_torch(radius)
        times = (torch.arange(count, device=place.device) * dt)[:, None, None]
        around.places = _pairs(place[:, None] + times * velocity[:, None])
        return around

    def _clearance(self, tensordict: TensorDictBase) -> tuple[Tensor, Tensor, int]:
        """Returns distances to what does not move, x and y of their grid's first point and its spacing, m, and side."""
        return *tensordict[SEEN_DISTANCES].split((SIZE**2, 3), -1), SIZE

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


class InformedPredictive(PredictivePolicy):
    """Plans as :class:`PredictivePolicy`, and knows the map and what moves around the rover, for imitation in training.

    It does not know what the movers will do. It reads the ``privileged`` observation, ``pose``, ``imu``, ``target`` and
    ``velocities``. ``worlds`` are usually ``RoverEnv.pool``.
    """

    def __init__(self, worlds: Worlds, robot: RobotLike) -> None:
        super().__init__(robot)
        self._worlds, self._grids = worlds, dict[int, tuple[Tensor, Tensor]]()

    def labels(self, observation: TensorDictBase, low: Tensor, high: Tensor) -> Tensor:
        """Returns weights of the actions of a grid within bounds ``[..., 2]``, which add up to one, ``[M, ACTIONS]``.

        Of two actions, the one that costs ``TEMPERATURE`` seconds more has a weight that is smaller by a factor of e.
        """
        keys = [*self.in_keys[:4], ("privileged", MOVERS), ("outcome", "world"), ("outcome", "steps")]
        rows, actions = observation.select(*keys, strict=False), self.actions().to(low)
        costs = torch.cat([self.costs(part) for part in rows.split(ROWS_AT_ONCE)])
        low, high = low[..., None, :], high[..., None, :]
        allowed = ((actions >= low) & (actions <= high)).all(-1)
        weights = (costs.clamp(max=WORST) / -TEMPERATURE).masked_fill(~allowed, -math.inf).softmax(-1)
        index = nearest_index(actions, low, high).expand_as(weights)
        return weights.new_zeros(len(weights), ACTIONS).scatter_add(1, index, weights)

    def _movers(self, tensordict: TensorDictBase) -> tuple[Tensor, Tensor, Tensor]:
        pose, imu, movers = tensordict["pose"], tensordict["imu"], tensordict["privileged", MOVERS]
        place, velocity, radius = movers.unflatten(-1, (-1, NUMBERS)).split((2, 2, 1), -1)
        return pose[:, None, :2] + in_world(place, imu), in_world(velocity, imu), radius[..., 0].contiguous()

    def _clearance(self, tensordict: TensorDictBase) -> tuple[Tensor, Tensor, int]:
        worlds = world_of(tensordict).flatten().tolist()
        for index in {*worlds} - {*self._grids}:
            self._grids[index] = _distances_in(self._worlds[index])
        distances, frames = zip(*map(self._grids.__getitem__, worlds), strict=True)
        return torch.stack(distances), torch.stack(frames), POINTS


def _distances_in(world: World) -> tuple[Tensor, Tensor]:
    """Distances to what does not move on a grid over a world, and x and y of its first point and its spacing, m."""
    (left, right), (low, high) = world.bounds
    spacing = max(right - left, high - low) / (POINTS - 1)
    steps = spacing * np.arange(POINTS)
    distances = clearance_on_grid(world.terrain, world.obstacles, left + steps, low + steps, FARTHEST)
    return distances.float().flatten(), torch.tensor([left, low, spacing])
