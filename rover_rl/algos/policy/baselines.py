"""Baseline policies: uniformly random actions and a scripted controller.

Example:
    >>> episodes = stored_episodes("maze").first(4)
    >>> evaluate(ScriptedPolicy(), episodes, name="scripted", seconds=2)
"""

from __future__ import annotations

import math
from functools import partial
from typing import NamedTuple

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torch import Tensor

from rover_rl.algos.policy.arcs import drive_to, hit_points
from rover_rl.envs.sensors.robot import RobotNumbers
from rover_rl.envs.specs import ACTION
from rover_rl.rng import episode_keys, random_bits, row_keys, to_unit
from rover_rl.robots import Robot, get_robot
from rover_rl.robots.built_in import ROVER_ZERO
from rover_rl.robots.turning import turn_gain
from rover_rl.rotations import wrap_angle
from rover_rl.sims.free_space.fitting import passage_scale

_ACTIONS = 0  # stream of random draws for actions


class RandomPolicy(TensorDictModuleBase):
    """Uniformly random actions within the contract's bounds, which depend on seed, episode and step only.

    The policy reads ``("outcome", "steps")`` and, if present, ``episode`` (int64 ``[N, 1]``): the number of each row's
    episode, by default the index of the row.
    """

    def __init__(self, seed: int = 0) -> None:
        super().__init__()
        self.in_keys = [("outcome", "steps")]
        self.out_keys = ["action"]
        self._seed = row_keys(seed, 1, torch.device("cpu"))

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        steps = tensordict["outcome", "steps"]
        episode = tensordict.get("episode", None)
        if episode is None:
            episode = torch.arange(len(steps), device=steps.device)[:, None]
        keys = episode_keys(self._seed.to(steps.device), episode)
        low, high = (torch.tensor(side, device=steps.device) for side in (ACTION.low, ACTION.high))
        return tensordict.set("action", low + (high - low) * to_unit(random_bits(keys, _ACTIONS, steps, 2)))


class ScriptedPolicy(TensorDictModule):
    """Drives towards the goal and around obstacles that the lidar detects: see :func:`steer`.

    Its distances are tuned for ``rover_zero`` and follow the outline of other robots: see ``lane_of``. A robot that
    does not turn in place drives in arcs, forward and backward.
    """

    def __init__(self, robot: str | Robot = "rover_zero") -> None:
        robot = get_robot(robot)
        offset, lane = robot.lidar_position[0], lane_of(robot)
        policy, in_keys = partial(steer, lidar_offset=offset, lane=lane), ["lidar", "target"]
        if not robot.drive.turns_in_place:
            policy = partial(steer_in_arcs, lidar_offset=offset, lane=lane, robot=robot)
            in_keys.append("velocities")
        super().__init__(policy, in_keys=in_keys, out_keys=["action"])


LIDAR_OFFSET = ROVER_ZERO.lidar_position[0]  # default distance of the lidar in front of the rover's center, m
HEADINGS = 64  # number of candidate directions, besides the direction of the goal
# Distance of Rover Zero up to which a direction is examined, m. On slopes, the lidar sees the ground beyond it.
LOOK_AHEAD = 1.6
SLOW = 0.8  # free distance beyond the one to stop at from which on the rover drives at full speed, m
# Weight of driving straight ahead relative to driving towards the goal. With a small weight, the rover alternates
# between two ways around an obstacle. In the maze, 94 % of episodes succeed within 30 s with 0.9, and 85 % with 1.3.
PERSISTENCE = 0.9


class Lane(NamedTuple):
    """Distances of a careful driver, m. The defaults are those of Rover Zero.

    Attributes:
        half_width: half the width of the lane that must be free. Half the width of Rover Zero is 0.225 m.
        stop: free distance from the robot's center at which it stops.
        back_off: lidar reading in front below which it backs off. A reading below 0.3 m is a collision of Rover Zero.
        behind: lidar reading behind that is required for backing off. The rear end of Rover Zero is 0.44 m from it.
        look_ahead: distance up to which a direction is examined.
        turn: heading offset for each radian to turn.
    """

    half_width: float = 0.36
    stop: float = 0.45
    back_off: float = 0.36
    behind: float = 0.75
    look_ahead: float = LOOK_AHEAD
    turn: float = 2.0


def lane_of(robot: Robot) -> Lane:
    """Returns the distances of a robot: those of Rover Zero, by as much larger as the robot's outline is."""
    side, front, ahead, behind = (round(a - b, 3) for a, b in zip(_reach(robot), _reach(ROVER_ZERO), strict=True))
    lane = Lane()
    back_off = lane.back_off + max(side, ahead)
    look_ahead = LOOK_AHEAD * passage_scale(robot)
    return Lane(lane.half_width + side, lane.stop + front, back_off, lane.behind + behind, look_ahead, turn_gain(robot))


def _reach(robot: Robot) -> tuple[float, float, float, float]:
    outline, lidar = robot.footprint, robot.lidar_position[0]
    return outline.half_width, outline.front, outline.front - lidar, lidar - outline.back


_ROVER_ZERO = Lane()


def steer(lidar: Tensor, target: Tensor, lidar_offset: float = LIDAR_OFFSET, lane: Lane = _ROVER_ZERO) -> Tensor:
    """Computes the action of a careful driver without a map and without memory: see :func:`drive_towards`.

    The rover drives towards the goal if the lane to the goal, or its first 1.6 m, is free. Otherwise it takes the best
    of 64 directions: free, and preferably towards the goal and ahead. ``target [N, 2]`` is the distance (m) and the
    angle (rad) to the goal.
    """
    return drive_towards(_way(lidar, target, lidar_offset, lane), lidar, lidar_offset, lane)


def steer_in_arcs(
    lidar: Tensor, target: Tensor, velocities: Tensor, lidar_offset: float, lane: Lane, robot: Robot
) -> Tensor:
    """Computes the action of the same driver in a car, which drives to a place in the direction that it has chosen."""
    distance, direction = target[:, :1], _way(lidar, target, lidar_offset, lane)
    numbers = RobotNumbers.of_robot(robot, lidar)
    place = distance.clamp(max=1.5 * numbers.min_radius) * torch.cat((direction.cos(), direction.sin()), -1)
    return drive_to(place, distance, lidar, velocities, numbers)


def _way(lidar: Tensor, target: Tensor, lidar_offset: float, lane: Lane) -> Tensor:
    """Returns the direction to drive in, ``[N, 1]``, rad: see :func:`steer`."""
    distance, bearing = target.split(1, -1)
    candidates = torch.arange(HEADINGS, dtype=lidar.dtype, device=lidar.device) * (2 * math.pi / HEADINGS)
    directions = torch.cat((candidates.expand(len(lidar), -1), bearing), -1)
    free = _free_lane(lidar, directions, lidar_offset, lane.half_width)
    blocked = (1 - free / distance.clamp(0.1, lane.look_ahead)).clamp(min=0)
    merit = (directions - bearing).cos() + PERSISTENCE * directions.cos() - 4 * blocked
    best = directions.gather(-1, merit.argmax(-1, keepdim=True))
    return torch.where(blocked[:, -1:] > 0, best, bearing)


def drive_towards(
    direction: Tensor,
    lidar: Tensor,
    lidar_offset: float = LIDAR_OFFSET,
    lane: Lane = _ROVER_ZERO,
    scan_pose: Tensor | None = None,
) -> Tensor:
    """Computes the action of a careful driver that follows a direction.

    The heading offset is twice the angle to the direction for Rover Zero. The speed decreases as the angle grows, and
    as obstacles in the lane ahead get closer. Directly in front of an obstacle, the rover backs off while it turns.

    Args:
        direction: direction relative to the rover's heading, ``[N, 1]``, rad.
        lidar: lidar readings, ``[N, points]``, m.
        lidar_offset: distance of the lidar in front of the rover's center, m.
        lane: distances of the robot.
        scan_pose: where the scan was taken, ``[N, 6]``, for the lane ahead. ``None``: where the rover is.

    Returns:
        Action ``[N, 2]``: forward speed (m/s) and heading offset (rad).
    """
    angle = wrap_angle(direction)
    free = _free_lane(lidar, torch.zeros_like(angle), lidar_offset, lane.half_width, scan_pose)
    speed = angle.cos().clamp(min=0) * ((free - lane.stop) / SLOW).clamp(0, 1)
    quarter = lidar.shape[-1] // 4
    front = torch.cat((lidar[:, :quarter], lidar[:, -quarter:]), -1).amin(-1, keepdim=True)
    behind = lidar[:, quarter + quarter // 2 : -quarter - quarter // 2].amin(-1, keepdim=True)
    speed = torch.where((front < lane.back_off) & (behind > lane.behind), -0.4, speed)
    return torch.cat((speed, (lane.turn * angle).clamp(-math.pi, math.pi)), -1)


def _free_lane(
    lidar: Tensor, directions: Tensor, lidar_offset: float, half_width: float, scan_pose: Tensor | None = None
) -> Tensor:
    """Free length of the lane from the rover's center in each of ``directions [N, H]``: ``[N, H]``, m."""
    x, y = (value[..., None] for value in hit_points(lidar, lidar_offset, scan_pose=scan_pose))
    cos, sin = directions.cos()[:, None], directions.sin()[:, None]
    ahead, aside = x * cos + y * sin, y * cos - x * sin
    return ahead.masked_fill((ahead < 0) | (aside.abs() > half_width), math.inf).amin(1)
