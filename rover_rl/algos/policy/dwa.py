"""DynamicWindowPolicy: a dynamic-window planner (DWA), a classical baseline without a map and without memory.

Source: D. Fox, W. Burgard, S. Thrun, "The dynamic window approach to collision avoidance", IEEE Robotics & Automation
Magazine 4(1), 1997. Trajectories are sampled and scored by critics, as in the planner DWB of ROS 2's Nav2.

The planner simulates one trajectory for each pair of forward speed and yaw rate that the rover can reach, rejects those
on which the body touches a lidar reading, and takes the one with the highest score. The critics are

========== =============================================================================================
heading    alignment of the end of the trajectory with the goal
course     alignment of the end of the trajectory with the current heading. It keeps a rover that goes around an
           obstacle from turning back. The original objective has no such term, and a planner with a global path
           aligns with that path instead.
free       free distance along the trajectory and straight on from its end, as a share of the look-ahead distance
speed      forward speed
clearance  distance of the body from the nearest reading, if it is less than a margin
lidar      expected lidar readings that are about to count as a collision, for a robot with a collision range
reverse    cost of driving backward
standstill cost of neither driving nor turning
========== =============================================================================================

Turning in place and backing off are trajectories like all others, so that the rover turns where nothing is free ahead,
and backs off where it cannot turn. If all trajectories are rejected, the rover takes the one with the largest sum of
the time until it touches a reading (s) and the clearance at its end (m). It drives through the goal; near it, slow
trajectories win where fast ones miss it.

The constants were chosen by hand from about 50 settings in maze:0-63, rooms:0-63, forest:0-63 and moon:0-31, in Warp,
by contact-free successes, then by time.

Example:
    >>> evaluate(DynamicWindowPolicy(), draw_episodes("maze:10000", count=2), name="dwa", seconds=2)
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from rover_rl.algos.policy.arcs import hit_points
from rover_rl.envs.config import EnvConfig, HeadingGains, LidarConfig, RobotLike
from rover_rl.envs.mover_tracker import MoverTracker
from rover_rl.robots import get_robot
from rover_rl.robots.footprint import covering_discs
from rover_rl.robots.turning import estimated_yaw_gain
from rover_rl.sims.free_space.fitting import passage_scale
from rover_rl.sims.settings import CONTROL_DT

LIDAR = LidarConfig(points=128)  # lidar of the planner by default: every beam of the scan

HORIZON = 1.5  # duration of a trajectory, s
# Number of poses of a trajectory that are examined. At 1 m/s they are 0.25 m apart, less than the body is long.
POSES = 6
# Forward speeds, in top speeds of the drive. At 5 m/s^2, Rover Zero reaches all of them, up to 1 m/s, within 0.26 s.
SPEEDS = (-0.3, 0.0, 1 / 3, 2 / 3, 1.0)
WINDOW = 0.8  # time in which a yaw rate must be reachable, s
MAX_YAW_RATE = 1.6  # maximum absolute yaw rate of the body, rad/s
YAW_RATES = 15  # number of yaw rates in the window, besides the one closest to 0
# Largest distance by which the discs that cover the footprint exceed its sides, m. With two discs, it is 0.037 m.
EXCESS = 0.04
SAFETY = 0.008  # distance of the discs below which a trajectory is rejected, m
ROOM = 0.04  # how much more that is for a robot that needs worlds twice as wide, m
LOOK_AHEAD = 1.6  # free distance beyond which more is no better, m. On slopes, the lidar sees the ground beyond it.
LANE_MARGIN = 0.075  # width of the lane beyond the end of a trajectory on each side of the footprint, m
ARRIVAL = 0.25  # distance from the goal at which a trajectory ends there, m

HEADING_WEIGHT = 0.75
COURSE_WEIGHT = 0.5
FREE_WEIGHT = 3.0
SPEED_WEIGHT = 0.9
CLEARANCE_WEIGHT = 1.0
CLEARANCE_MARGIN = 0.2  # clearance without a cost, m
LIDAR_WEIGHT = 2.0
LIDAR_MARGIN = 0.06  # margin above the collision range of the robot in which expected readings cost, m
REVERSE_COST = 0.5
STANDSTILL_COST = 2.0
STANDSTILL = 0.2  # yaw rate below which a rover without speed stands still, rad/s
_FAR = 1e3  # coordinate of readings that hit nothing, and of what does not move, m
MOVER_MARGIN = 0.05  # added to the radius of what moves, m
_ROWS = 16  # number of rows that are planned for at once on a CPU. Their distances fit into its cache.
_ROWS_ACCELERATOR = 1024  # number of rows that are planned for at once on an accelerator. Limits the memory to 1 GB.


class Trajectories(NamedTuple):
    """Sampled trajectories of each row: S of them with K poses, in the base frame of the rover as it is now.

    ``speed`` and ``yaw_rate [N, S]`` (m/s, rad/s) are those that each approaches, ``time [K]`` (s) is that of the
    poses, ``path [N, S, K]`` (m) the distance driven, negative backward, and the others are poses ``[N, S, K]`` (m,
    rad).
    """

    speed: Tensor
    yaw_rate: Tensor
    time: Tensor
    path: Tensor
    x: Tensor
    y: Tensor
    heading: Tensor


class DynamicWindowPolicy(TensorDictModuleBase):
    """Dynamic-window planner (DWA): see :mod:`rover_rl.algos.policy.dwa`.

    For a robot that does not turn in place, it samples curvatures in the place of yaw rates. The policy reads
    ``lidar``, ``target`` and ``velocities``. Its constants are tuned for ``rover_zero``. ``made_for`` is the
    environment that it drives in, with ``robot`` and ``lidar``.

    Args:
        robot: name of a robot, or a robot, whose footprint, acceleration limits and lidar position are used.
        lidar: lidar that the policy reads: number of readings and beams, and range.
        yaw_gain: yaw rate of the body relative to that of the wheel odometry; 1 for wheels that do not slip. ``None``:
            an estimate from the drive, 0.41 for Rover Zero, and 1 for drives that turn without slip.

    Raises:
        ValueError: for an unknown robot, or a ``yaw_gain`` that is not positive.
    """

    def __init__(
        self, robot: RobotLike = "rover_zero", lidar: LidarConfig = LIDAR, yaw_gain: float | None = None
    ) -> None:
        super().__init__()
        self.in_keys, self.out_keys = ["lidar", "target", "velocities"], ["action"]
        self.made_for, self._robot = EnvConfig(robot=robot, lidar=lidar), get_robot(robot)
        self._gain = estimated_yaw_gain(self._robot) if yaw_gain is None else yaw_gain
        if not 0 < self._gain < math.inf:
            raise ValueError(f"yaw_gain must be a positive number, got {self._gain}")
        centers, radius = covering_discs(self._robot, EXCESS)
        self._scale = passage_scale(self._robot)
        self._discs, self._radius = tuple(centers.tolist()), radius + SAFETY + ROOM * (self._scale - 1)
        # In micrometers, so that sums do not round differently.
        self._half_lane = round(self._robot.footprint.half_width + LANE_MARGIN, 6)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        return tensordict.set("action", self._act([tensordict[key] for key in self.in_keys]))

    def _act(self, inputs: list[Tensor]) -> Tensor:
        rows = _ROWS if inputs[0].device.type == "cpu" else _ROWS_ACCELERATOR
        parts = zip(*(value.split(rows) for value in inputs), strict=True)
        return torch.cat([self._plan(*part) for part in parts])

    def _plan(self, lidar: Tensor, target: Tensor, velocities: Tensor, *moving: Tensor) -> Tensor:
        points, sampled = self.points(lidar), self.trajectories(velocities)
        clearance, readings, now = self._clearances(points, sampled)
        if moving:
            clearance = torch.minimum(clearance, self._moving_clearance(sampled, *moving))
        goal = target[:, :1] * torch.cat((target[:, 1:].cos(), target[:, 1:].sin()), -1)
        to_goal = torch.hypot(goal[:, :1, None] - sampled.x, goal[:, 1:, None] - sampled.y)
        arrived = to_goal.cummin(-1).values < ARRIVAL
        # A body that is too close already may move as long as it does not get closer.
        hit = (clearance < (now - 0.002).clamp(max=0)[:, None, None]) & ~arrived
        score = self._score(sampled, points, goal, arrived, clearance, readings)
        free_time = torch.where(hit, sampled.time, math.inf).amin(-1)
        # All scores of rejected trajectories are below those of the others.
        escape = free_time.clamp(max=HORIZON) + clearance[..., -1].clamp(max=1) - 100
        best = torch.where(hit.any(-1), escape, score).argmax(-1, keepdim=True)
        speed, yaw_rate = sampled.speed.gather(-1, best), sampled.yaw_rate.gather(-1, best)
        # The heading PID commands the wheels to turn at kp times a constant heading offset.
        offset = (yaw_rate / (self._gain * HeadingGains.kp)).clamp(-math.pi, math.pi)
        return torch.cat((speed, offset), -1)

    def points(self, lidar: Tensor) -> Tensor:
        """Returns the points that lidar readings ``[N, points]`` (m) hit, in the base frame, ``[N, points, 2]``, m."""
        config, (ahead, aside, _) = self.made_for.lidar, self._robot.lidar_position
        # Beam 0 points forward, and the first of b beams of segment i is beam i b. Its middle counts.
        x, y = hit_points(lidar, ahead, middle=max(0.0, (1 - lidar.shape[-1] / config.beams) / 2))
        return torch.stack((x, y + aside), -1).masked_fill((lidar >= config.max_range)[..., None], _FAR)

    def trajectories(self, velocities: Tensor) -> Trajectories:
        """Samples the trajectories of rovers with the wheel odometry ``velocities [N, 2]`` (m/s, rad/s).

        Speed and yaw rate change at the limits of the drive until they reach the sampled ones.
        """
        drive, (v0, w0) = self._robot.drive, velocities.split(1, -1)
        v = v0.new_tensor(SPEEDS).mul(drive.max_speed).expand(len(v0), -1)
        time = torch.arange(1, POSES + 1, dtype=v0.dtype, device=v0.device) * (HORIZON / POSES)
        path = _ramp(v0[..., None], v[..., None], drive.max_linear_acceleration, time)[:, :, None]
        sample = self._turns if drive.turns_in_place else self._arcs
        yaw_rate, heading, x, y = sample(v, path, w0 * self._gain, time)
        pairs = [value.expand_as(x).flatten(1, 2) for value in (path, x, y, heading)]
        return Trajectories(v[..., None].expand_as(yaw_rate).flatten(1), yaw_rate.flatten(1), time, *pairs)

    def _turns(self, v: Tensor, path: Tensor, w0: Tensor, time: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Returns yaw rates within reach, ``[N, V, W]``, with which rovers drive, headings, and x and y."""
        yaw_acceleration = self._robot.drive.max_angular_acceleration * self._gain
        share = torch.linspace(0, 1, YAW_RATES, dtype=w0.dtype, device=w0.device)
        reach = (-yaw_acceleration, yaw_acceleration)
        low, high = ((w0 + side * WINDOW).clamp(-MAX_YAW_RATE, MAX_YAW_RATE) for side in reach)
        w = torch.cat((low + (high - low) * share, torch.zeros_like(w0).clamp(low, high)), -1)
        heading = _ramp(w0[..., None], w[..., None], yaw_acceleration, time)[:, None]
        # Each piece between two poses is driven at the mean of their headings.
        step = path.diff(dim=-1, prepend=torch.zeros_like(path[..., :1]))
        mean = heading - heading.diff(dim=-1, prepend=torch.zeros_like(heading[..., :1])) / 2
        x, y = (step * mean.cos()).cumsum(-1), (step * mean.sin()).cumsum(-1)
        return w[:, None].expand(-1, v.shape[1], -1), heading, x, y

    def _arcs(self, v: Tensor, path: Tensor, w0: Tensor, time: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Returns the same of a robot that does not turn in place: arcs of all curvatures that its drive takes."""
        drive, wheels = self._robot.drive, self._robot.wheels
        sharpest, pivot = 1 / drive.min_radius(wheels), drive.pivot(wheels)
        curvature = torch.linspace(-sharpest, sharpest, YAW_RATES, dtype=v.dtype, device=v.device)[:, None]
        heading = path * curvature
        # The chord of an arc has the mean of its headings. The pivot is on the arc, and not the base frame.
        chord = path * torch.sinc(heading / (2 * math.pi))
        x = chord * (heading / 2).cos() + pivot * (1 - heading.cos())
        y = chord * (heading / 2).sin() - pivot * heading.sin()
        return v[..., None] * curvature[:, 0], heading, x, y

    def _clearances(self, points: Tensor, sampled: Trajectories) -> tuple[Tensor, Tensor, Tensor]:
        """Returns distances to the nearest of ``points [N, P, 2]``, m: of body and lidar in poses, of the body now."""
        offsets = (*self._discs, self._robot.lidar_position[0])
        cos, sin = sampled.heading.cos(), sampled.heading.sin()
        x = torch.stack([sampled.x + offset * cos for offset in offsets], -1)
        y = torch.stack([sampled.y + offset * sin for offset in offsets], -1)
        here = x.new_tensor(offsets).expand(len(x), -1)
        x, y = (torch.cat((here * side, value.flatten(1)), -1) for side, value in ((1, x), (0, y)))
        # |c - p|^2 = |c|^2 + |p|^2 - 2 c p; the last two terms are a product of matrices, [P, 3] by [3, M].
        terms = torch.cat((-2 * points, points.square().sum(-1, keepdim=True)), -1)
        nearest = _lowest_product(terms, torch.stack((x, y, torch.ones_like(x)), 1))
        distance = (nearest + x.square() + y.square()).clamp(min=0).sqrt()
        now = distance[:, : len(self._discs)]
        along = distance[:, len(offsets) :].unflatten(-1, (*sampled.x.shape[1:], -1))
        return along[..., :-1].amin(-1) - self._radius, along[..., -1], now.amin(-1) - self._radius

    def _score(
        self, sampled: Trajectories, points: Tensor, goal: Tensor, arrived: Tensor, clearance: Tensor, readings: Tensor
    ) -> Tensor:
        """Returns the weighted sum of the critics for each trajectory, ``[N, S]``, until it has ``arrived``."""
        x, y, heading, arrives = sampled.x[..., -1], sampled.y[..., -1], sampled.heading[..., -1], arrived[..., -1]
        look_ahead = goal.norm(dim=-1, keepdim=True).clamp(0.1, LOOK_AHEAD * self._scale)
        free = ((sampled.path[..., -1] + _free_lane(x, y, heading, points, self._half_lane)) / look_ahead).clamp(0, 1)
        alignment = (torch.atan2(goal[:, 1:] - y, goal[:, :1] - x) - heading).cos()
        near = 1 - clearance.masked_fill(arrived, math.inf).amin(-1) / (CLEARANCE_MARGIN * self._scale)
        colliding = ((self._robot.collision_range or 0.0) + LIDAR_MARGIN - readings) / LIDAR_MARGIN
        stands = (sampled.speed == 0) & (sampled.yaw_rate.abs() < STANDSTILL)
        return (
            HEADING_WEIGHT * alignment.masked_fill(arrives, 1.0)
            + COURSE_WEIGHT * heading.cos()
            + FREE_WEIGHT * free.masked_fill(arrives, 1.0)
            + SPEED_WEIGHT * sampled.speed.clamp(min=0)
            - CLEARANCE_WEIGHT * near.clamp(0, 1)
            - LIDAR_WEIGHT * colliding.clamp(0, 2).mean(-1)
            - REVERSE_COST * (sampled.speed < 0)
            - STANDSTILL_COST * stands
        )

    def _moving_clearance(self, sampled: Trajectories, position: Tensor, velocity: Tensor, radius: Tensor) -> Tensor:
        """Returns the distance of the body in each pose from what moves, where that will be then, ``[N, S, K]``, m."""
        later = position[:, :, None] + sampled.time[:, None] * velocity[:, :, None]
        nearest = torch.full_like(sampled.x, math.inf)
        for offset in self._discs:
            x, y = sampled.x + offset * sampled.heading.cos(), sampled.y + offset * sampled.heading.sin()
            away = torch.hypot(x[:, None] - later[:, :, None, :, 0], y[:, None] - later[:, :, None, :, 1])
            nearest = torch.minimum(nearest, (away - radius[:, :, None, None]).amin(1))
        return nearest - self._radius


class MovingDynamicWindowPolicy(DynamicWindowPolicy):
    """Dynamic-window planner that follows what moves with a :class:`~rover_rl.envs.mover_tracker.MoverTracker`.

    A trajectory is rejected if the body touches where a track will be at the time of a pose, at constant velocity.
    Readings that belong to such a track are no obstacles at rest.

    The policy also reads ``pose`` and ``imu``, and remembers tracks. It decides every ``trained_action_repeat`` steps.
    """

    trained_action_repeat = 2

    def __init__(
        self, robot: RobotLike = "rover_zero", lidar: LidarConfig = LIDAR, yaw_gain: float | None = None
    ) -> None:
        super().__init__(robot, lidar, yaw_gain)
        self.in_keys = ["lidar", "target", "velocities", "pose", "imu", "is_init", "tracks"]
        self.out_keys = ["action", ("next", "tracks")]  # type: ignore[list-item]
        self._tracker = MoverTracker(self._robot, lidar, self.trained_action_repeat * CONTROL_DT)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        state, tracks = self._tracker.remembered(tensordict)
        moving = tracks.in_base_frame(tensordict)
        lidar = torch.where(tracks.readings, self.made_for.lidar.max_range, tensordict["lidar"])
        position = moving.position.masked_fill(~moving.moves[..., None], _FAR)
        inputs = [lidar, tensordict["target"], tensordict["velocities"]]
        action = self._act([*inputs, position, moving.velocity, moving.radius + MOVER_MARGIN])
        return tensordict.set("action", action).set(("next", "tracks"), state)


def _ramp(start: Tensor, end: Tensor, rate: float, time: Tensor) -> Tensor:
    """Returns the integral over ``time`` of a value that goes from ``start`` to ``end`` at ``rate`` and stays there."""
    change = end - start
    ramping = torch.minimum(time, change.abs() / rate)
    return start * time + change.sign() * rate * ramping * (time - ramping / 2)


def _free_lane(x: Tensor, y: Tensor, heading: Tensor, points: Tensor, half_width: float) -> Tensor:
    """Returns the free length of the lanes straight ahead from poses ``[N, S]``, ``[N, S]``, m."""
    cos, sin = heading.cos()[:, None], heading.sin()[:, None]
    px, py = points.split(1, -1)
    ahead = px * cos + py * sin - (cos * x[:, None] + sin * y[:, None])
    aside = py * cos - px * sin + (sin * x[:, None] - cos * y[:, None])
    return ahead.masked_fill((ahead < 0) | (aside.abs() > half_width), _FAR).amin(1)


def _lowest_product(left: Tensor, right: Tensor) -> Tensor:
    """Returns the lowest entry of each column of ``left [N, P, 3] @ right [N, 3, M]``, ``[N, M]``."""
    if left.device.type != "cpu":
        return (left @ right).amin(1)
    # On a CPU, products of single rows in the same memory are several times faster than a batch of them.
    product = left.new_empty(left.shape[1], right.shape[2])
    rows = zip(left.unbind(), right.unbind(), strict=True)
    return torch.stack([torch.mm(a, b, out=product).amin(0) for a, b in rows])
