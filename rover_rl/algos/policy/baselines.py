"""Baseline policies: uniformly random actions and a scripted controller.

Example:
    >>> episodes = stored_episodes("maze").first(4)
    >>> evaluate(ScriptedPolicy(), episodes, name="scripted", seconds=20)
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from rover_rl.algos.policy.arcs import drive_to, hit_points
from rover_rl.envs.actions import ACTION
from rover_rl.envs.sensors.robot import RobotNumbers
from rover_rl.rng import episode_keys, random_bits, row_keys, to_unit
from rover_rl.robots import Robot, get_robot
from rover_rl.robots.built_in import ROVER_ZERO
from rover_rl.robots.turning import turn_gain
from rover_rl.rotations import wrap_angle
from rover_rl.sims.free_space.fitting import passage_scale

_ACTIONS = 0  # stream of random draws for actions
HEADINGS = 64  # number of candidate directions, besides the direction of the goal
SLOW = 0.8  # free distance beyond the one to stop at from which on the rover drives at full speed, m
# Weight of driving straight ahead relative to driving towards the goal. With a small weight, the rover alternates
# between two ways around an obstacle. In the maze, 94 % of episodes succeed within 30 s with 0.9, and 85 % with 1.3.
PERSISTENCE = 0.9


class RandomPolicy(TensorDictModuleBase):
    """Uniformly random actions within the contract's bounds, which depend on seed, episode and step only.

    The policy reads ``("outcome", "steps")`` and, if present, ``episode`` (int64 ``[N, 1]``): the number of each row's
    episode, by default the index of the row.
    """

    def __init__(self, seed: int = 0) -> None:
        super().__init__()
        self.in_keys, self.out_keys = [("outcome", "steps")], ["action"]
        self._seed = row_keys(seed, 1, torch.device("cpu"))

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        steps = tensordict["outcome", "steps"]
        episode = tensordict.get("episode", None)
        if episode is None:
            episode = torch.arange(len(steps), device=steps.device)[:, None]
        keys = episode_keys(self._seed.to(steps.device), episode)
        low, high = ACTION.tensors(steps.device)
        return tensordict.set("action", low + (high - low) * to_unit(random_bits(keys, _ACTIONS, steps, 2)))


class Lane(NamedTuple):
    """Distances of a careful driver, m. The defaults are those of Rover Zero.

    Attributes:
        half_width: half the width of the lane that must be free. Half the width of Rover Zero is 0.225 m.
        stop: free distance from the robot's center at which it stops.
        back_off: lidar reading in front below which it backs off. A reading below 0.3 m is a collision of Rover Zero.
        behind: lidar reading behind that is required for backing off. The rear end of Rover Zero is 0.44 m from it.
        look_ahead: distance up to which a direction is examined. On slopes, the lidar sees the ground beyond it.
        turn: heading offset for each radian to turn.
        lidar: distance of the lidar in front of the robot's center.
    """

    half_width: float = 0.36
    stop: float = 0.45
    back_off: float = 0.36
    behind: float = 0.75
    look_ahead: float = 1.6
    turn: float = 2.0
    lidar: float = ROVER_ZERO.lidar_position[0]

    @classmethod
    def of(cls, robot: Robot) -> Lane:
        """Returns the distances of a robot: those of Rover Zero, by as much larger as the robot's outline is."""
        lane, reaches = cls(), zip(_reach(robot), _reach(ROVER_ZERO), strict=True)
        side, front, ahead, behind = (round(a - b, 3) for a, b in reaches)
        back_off, look_ahead = lane.back_off + max(side, ahead), lane.look_ahead * passage_scale(robot)
        sizes = lane.half_width + side, lane.stop + front, back_off, lane.behind + behind, look_ahead
        return cls(*sizes, turn_gain(robot), robot.lidar_position[0])


def _reach(robot: Robot) -> tuple[float, float, float, float]:
    outline, lidar = robot.footprint, robot.lidar_position[0]
    return outline.half_width, outline.front, outline.front - lidar, lidar - outline.back


class ScriptedPolicy(TensorDictModuleBase):
    """Drives towards the goal and around obstacles that the lidar detects, without a map and without memory.

    The rover drives towards the goal if the lane to the goal, or its first 1.6 m, is free. Otherwise it takes the best
    of 64 directions: free, and preferably towards the goal and ahead. See :func:`drive_towards`. A robot that does not
    turn in place drives to a place in this direction in arcs, forward and backward.

    Its distances are tuned for ``rover_zero`` and follow the outline of other robots.
    """

    def __init__(self, robot: str | Robot = "rover_zero") -> None:
        super().__init__()
        self._robot = get_robot(robot)
        self._lane = Lane.of(self._robot)
        self.in_keys, self.out_keys = ["lidar", "target"], ["action"]
        if not self._robot.drive.turns_in_place:
            self.in_keys.append("velocities")

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        lidar, target = tensordict["lidar"], tensordict["target"]
        direction = way_to(target, lidar, self._lane)
        if self._robot.drive.turns_in_place:
            return tensordict.set("action", drive_towards(direction, lidar, self._lane))
        distance, numbers = target[:, :1], RobotNumbers.of_robot(self._robot, lidar)
        place = distance.clamp(max=1.5 * numbers.min_radius) * torch.cat((direction.cos(), direction.sin()), -1)
        return tensordict.set("action", drive_to(place, distance, lidar, tensordict["velocities"], numbers))


def way_to(target: Tensor, lidar: Tensor, lane: Lane) -> Tensor:
    """Returns the direction to drive in to ``target [N, 2]`` (m, rad), ``[N, 1]``, rad."""
    distance, bearing = target.split(1, -1)
    candidates = torch.arange(HEADINGS, dtype=lidar.dtype, device=lidar.device) * (2 * math.pi / HEADINGS)
    directions = torch.cat((candidates.expand(len(lidar), -1), bearing), -1)
    blocked = (1 - _free_lane(lidar, directions, lane) / distance.clamp(0.1, lane.look_ahead)).clamp(min=0)
    merit = (directions - bearing).cos() + PERSISTENCE * directions.cos() - 4 * blocked
    best = directions.gather(-1, merit.argmax(-1, keepdim=True))
    return torch.where(blocked[:, -1:] > 0, best, bearing)


def drive_towards(direction: Tensor, lidar: Tensor, lane: Lane, scan_pose: Tensor | None = None) -> Tensor:
    """Computes the action of a careful driver that follows a direction.

    The heading offset is twice the angle to the direction for Rover Zero. The speed decreases as the angle grows, and
    as obstacles in the lane ahead get closer. Directly in front of an obstacle, the rover backs off while it turns.

    Args:
        direction: direction relative to the rover's heading, ``[N, 1]``, rad.
        lidar: lidar readings, ``[N, points]``, m.
        lane: distances of the robot.
        scan_pose: where the scan was taken, ``[N, 6]``, for the lane ahead. ``None``: where the rover is.

    Returns:
        Action ``[N, 2]``: forward speed (m/s) and heading offset (rad).
    """
    angle = wrap_angle(direction)
    free = _free_lane(lidar, torch.zeros_like(angle), lane, scan_pose)
    speed = angle.cos().clamp(min=0) * ((free - lane.stop) / SLOW).clamp(0, 1)
    quarter = lidar.shape[-1] // 4
    front = torch.cat((lidar[:, :quarter], lidar[:, -quarter:]), -1).amin(-1, keepdim=True)
    behind = lidar[:, quarter + quarter // 2 : -quarter - quarter // 2].amin(-1, keepdim=True)
    speed = torch.where((front < lane.back_off) & (behind > lane.behind), -0.4, speed)
    return torch.cat((speed, (lane.turn * angle).clamp(-math.pi, math.pi)), -1)


def _free_lane(lidar: Tensor, directions: Tensor, lane: Lane, scan_pose: Tensor | None = None) -> Tensor:
    """Returns the free length of the lane from the rover's center in ``directions [N, H]``: ``[N, H]``, m."""
    x, y = (value[..., None] for value in hit_points(lidar, lane.lidar, scan_pose=scan_pose))
    cos, sin = directions.cos()[:, None], directions.sin()[:, None]
    ahead, aside = x * cos + y * sin, y * cos - x * sin
    return ahead.masked_fill((ahead < 0) | (aside.abs() > lane.half_width), math.inf).amin(1)
