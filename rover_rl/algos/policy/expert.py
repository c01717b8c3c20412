"""PrivilegedExpert: planner that uses the map and the pose, for imitation in training and as an upper bound."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from rover_rl.algos.policy.arcs import drive_to
from rover_rl.algos.policy.baselines import Lane, drive_towards
from rover_rl.algos.policy.grid_planner import AHEAD, SHARP, SLOPE, SLOPE_SPEED
from rover_rl.envs.config import SCAN_POSE, EnvConfig, LidarConfig, RobotLike
from rover_rl.envs.rover import RoverEnv
from rover_rl.envs.sensors.robot import RobotNumbers
from rover_rl.envs.transforms.path_reward import goal_of, world_of
from rover_rl.robots import Robot, get_robot
from rover_rl.rotations import wrap_angle
from rover_rl.sims.free_space.paths import PathDistances
from rover_rl.worlds.world import Worlds

# Number of candidate headings. At the larger look-ahead distance, neighbors are 4 cm apart, so that one of them
# points into a lane that is one cell wide.
DIRECTIONS = 64
# Distances at which each candidate heading is evaluated, anywhere and in narrow passages, m.
LOOK_AHEAD, LOOK_AHEAD_NARROW = (0.2, 0.4), (0.15, 0.3)
CAUTION = 4.0  # relative extra cost of a path right beside an obstacle: a meter there counts as five
BLOCKED = 50.0  # penalty on the path length for a point that is not free, m
CREEP = 0.4  # speed in narrow passages, m/s
ALIGNED = 0.3  # angle to the direction of a narrow passage at which the expert stands still to turn, rad
# Angle that the rover still turns while its wheels stop turning it, over the square of their yaw rate, s^2/rad. Their
# yaw rate decreases by 4 rad/s^2, and the body turns at 0.4 times that rate: 0.4 / (2 * 4).
OVERSHOOT = 0.05
# Angle to the direction above which the rover drives backward on a slope, rad. While it turns around, it slides.
BACKWARD = math.radians(120)
BACKWARD_SPEED = 0.5  # largest speed backward on a slope, m/s
MAX_OFFSET = 3.0  # largest heading offset on a slope, rad. With pi, the sign of the heading error would be random.
STRIDE = 0.4  # length of the steps along the path to the place that arcs lead to, m
NEAR = 0.8  # distance to the goal below which the expert drives straight to it, m
READ = ("pose", "imu", "target", "lidar", "velocities", "outcome")
"""Entries of an observation that the expert reads, beside ``scan_pose`` where scans can be late."""


class PrivilegedExpert:
    """Expert that follows the shortest free path, which it computes from the map and the pose.

    A robot that does not turn in place follows it in arcs, forward and backward. A policy without the map and the pose
    can imitate it: see ``imitation`` in :class:`~rover_rl.algos.config.PPOConfig`. ``worlds`` are usually
    ``RoverEnv.pool``. Observations must contain ``READ``, and are on the ``device``.
    """

    def __init__(self, worlds: Worlds, robot: Robot, device: torch.device | str | None = None) -> None:
        self._distances, self._robot, self._lane = PathDistances(worlds, robot, device, CAUTION), robot, Lane.of(robot)
        self._angles = torch.arange(DIRECTIONS, device=device) * (2 * math.pi / DIRECTIONS)
        self._directions = torch.stack((self._angles.cos(), self._angles.sin()), -1)

    def action(self, observation: TensorDictBase) -> Tensor:
        """Returns actions ``[N, ..., 2]`` for observations ``[N, ...]``: forward speed (m/s), heading offset (rad)."""
        rows = observation.select(*READ, SCAN_POSE, strict=False).flatten()
        position, fields = rows["pose"][:, :2], self._distances.fields(world_of(rows)[:, 0], goal_of(rows))
        act = self._turning if self._robot.drive.turns_in_place else self._in_arcs
        return act(rows, position, fields).reshape(*observation.batch_size, 2)

    def _turning(self, rows: TensorDictBase, position: Tensor, fields: Tensor) -> Tensor:
        """Returns the actions of robots that turn in place, ``[M, 2]``."""
        direction = self._best_heading(fields, position, LOOK_AHEAD)
        distance, bearing = rows["target"].split(1, -1)
        ahead = torch.cat((direction.cos(), direction.sin()), -1)
        points = torch.stack([position, *(position + distance * ahead for distance in LOOK_AHEAD)], 1)
        narrow = self._distances.narrow(fields, points).any(-1, keepdim=True)
        tilt, yaw = rows["imu"].split((2, 1), -1)
        turn = torch.where(distance < NEAR, bearing, wrap_angle(direction - yaw))
        scan, sloped = (rows["lidar"], self._lane, rows.get(SCAN_POSE, None)), tilt.norm(dim=-1, keepdim=True) > SLOPE
        on_slope = _drive_on_slope(turn, rows["velocities"][:, 1:], *scan)
        careful = torch.where(sloped, on_slope, drive_towards(turn, *scan))
        passage = wrap_angle(self._best_heading(fields, position, LOOK_AHEAD_NARROW) - yaw)
        return torch.where(narrow, _pass_through(passage, sloped, self._lane.turn), careful)

    def _in_arcs(self, rows: TensorDictBase, position: Tensor, fields: Tensor) -> Tensor:
        """Returns the actions of robots that do not turn in place, ``[M, 2]``: to a place on the path ahead."""
        place, yaw = position, rows["imu"][:, 2:]
        reach = AHEAD * self._robot.drive.min_radius(self._robot.wheels)
        for _ in range(math.ceil(reach / STRIDE)):
            heading = self._best_heading(fields, place, LOOK_AHEAD)
            place = place + STRIDE * torch.cat((heading.cos(), heading.sin()), -1)
        # Near the goal, the place is the goal.
        place = torch.where(rows["target"][:, :1] < reach, goal_of(rows), place)
        away = place - position
        cos, sin = yaw.cos(), yaw.sin()
        ahead = torch.cat((away[:, :1] * cos + away[:, 1:] * sin, away[:, 1:] * cos - away[:, :1] * sin), -1)
        length = self._distances.along(fields, position)[0][:, None]
        numbers = RobotNumbers.of_robot(self._robot, rows["lidar"])
        return drive_to(ahead, length, rows["lidar"], rows["velocities"], numbers, rows.get(SCAN_POSE, None))

    def _best_heading(self, fields: Tensor, position: Tensor, look_ahead: tuple[float, ...]) -> Tensor:
        """Returns the heading with the shortest path to the goal of each row's field, in the world, ``[M, 1]``, rad."""
        length = position.new_zeros(len(position), DIRECTIONS)
        for distance in look_ahead:
            path, is_free = self._distances.along(fields, position[:, None] + distance * self._directions)
            length += path + BLOCKED * ~is_free
        return self._angles[length.argmin(-1, keepdim=True)]


class MapExpert(TensorDictModuleBase):
    """The :class:`PrivilegedExpert` of a robot as a policy: what is possible with the map of the world.

    A :class:`~rover_rl.algos.policy.runner.PolicyRunner` with an environment tells it the worlds.
    """

    def __init__(self, robot: RobotLike = "rover_zero") -> None:
        super().__init__()
        lidar = LidarConfig()
        if not get_robot(robot).drive.turns_in_place:
            # Of its arcs, the expert drops those on which the body would touch what the lidar sees.
            lidar = replace(lidar, points=lidar.beams)
        self.made_for, self._robot = EnvConfig(robot=robot, lidar=lidar), get_robot(robot)
        self.in_keys, self.out_keys = [*READ], ["action"]
        self._expert: PrivilegedExpert | None = None

    def enter(self, env: RoverEnv) -> None:
        self._expert = PrivilegedExpert(env.pool, self._robot, env.device)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        if self._expert is None:
            raise RuntimeError("the expert knows no map: drive it with PolicyRunner(policy, env=env)")
        return tensordict.set("action", self._expert.action(tensordict))


def _drive_on_slope(turn: Tensor, rate: Tensor, lidar: Tensor, lane: Lane, scan_pose: Tensor | None) -> Tensor:
    """Returns the actions ``[M, 2]`` of a rover on a slope, where it slides while it turns on the spot.

    ``turn [M, 1]`` is the angle to the direction of the path, rad, and ``rate [M, 1]`` the wheels' yaw rate, rad/s.
    """
    overshoot = OVERSHOOT * rate * rate.abs()
    speed, offset = drive_towards(turn - overshoot, lidar, lane, scan_pose).split(1, -1)
    tail = wrap_angle(turn + math.pi)
    speed = torch.where(turn.abs() > SHARP, speed.clamp(max=SLOPE_SPEED), speed.clamp(min=SLOPE_SPEED))
    speed = torch.where(turn.abs() > BACKWARD, -BACKWARD_SPEED * tail.cos(), speed)
    offset = torch.where(turn.abs() > BACKWARD, lane.turn * (tail - overshoot), offset)
    return torch.cat((speed, offset.clamp(-MAX_OFFSET, MAX_OFFSET)), -1)


def _pass_through(turn: Tensor, sloped: Tensor, gain: float) -> Tensor:
    """Returns the actions ``[M, 2]`` in a narrow passage whose direction is at the angle ``turn [M, 1]`` (rad)."""
    speed = CREEP * (1 - turn.abs() / ALIGNED).clamp(min=0)
    # Slower, it would stand still while it turns.
    speed = torch.where(sloped & (turn.abs() < SHARP), speed.clamp(min=SLOPE_SPEED), speed)
    return torch.cat((speed, (gain * turn).clamp(-math.pi, math.pi)), -1)
