"""``GridPlanner``: classical baseline that plans on a grid map of what the lidar has seen and follows the route.

Example:
    >>> policy = GridPlanner()
    >>> env = make_env(sensors_for(policy, replace(policy.made_for, world="maze", num_envs=4)))
    >>> runner = PolicyRunner(policy)
    >>> runner(env.reset()).shape
    torch.Size([4, 2])
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from rover_rl.algos.policy.arcs import drive_to, hit_points
from rover_rl.envs.config import SCAN_POSE, EnvConfig, LidarConfig, RobotLike, TaskConfig
from rover_rl.envs.sensors.robot import RobotNumbers
from rover_rl.envs.sensors.suite import MOVERS, ROUTE
from rover_rl.robots import Robot, get_robot
from rover_rl.robots.turning import turn_gain

MARGIN = 0.02  # free distance on each side of the footprint in the lane ahead, m
STOP = 0.05  # free distance in front of the footprint at which the rover stops, m
SLOW = 0.6  # free distance beyond that at which it drives at full speed, m
BEHIND = 0.3  # free distance behind the footprint that is required for backing off, m
BACK_OFF = -0.3  # speed of backing off, m/s
STEEP = 0.42  # pitch above which a slope is too steep, rad: 24 degrees, as for the map
BACK_DOWN = -0.5  # speed of backing down a slope, m/s
CREEP = 0.1  # lowest speed in a free lane, m/s
TURN = 1.2  # angle to the route from which on the rover turns on the spot, rad
# Tilt of the rover above which it drives as on a slope, where it slides while it turns on the spot, rad.
SLOPE = math.radians(5)
# Angle to the route above which it drives slowly on a slope, rad. At 0.5 m/s, the wheels of one side would rest while
# the others turn the rover as fast as they can, and it would stand still, as measured on slopes of 20 degrees.
SHARP = math.radians(45)
SLOPE_SPEED = 0.2  # speed in sharp turns on a slope, m/s
AHEAD = 1.5  # distance along the route to which arcs lead, in smallest radii


class GridPlanner(TensorDictModuleBase):
    """Follows the shortest route on a map of what the lidar has seen in the episode: see :func:`follow`.

    A robot that does not turn in place follows it in arcs, forward and backward: see :func:`follow_in_arcs`.

    It is the stack of costmap, planner and path follower of mobile robots, such as that of Nav2. What has not been seen
    counts as free. See :class:`~rover_rl.envs.seen_map.seen_map.SeenMap`.

    The policy reads ``lidar``, ``imu`` and ``route``, for a robot that does not turn in place ``velocities``, and where
    scans can be late ``scan_pose``. It plans every ``trained_action_repeat`` steps. ``made_for`` is the environment
    that it drives in, with a lidar reading for each beam, and episodes that end when the body touches something.
    """

    trained_action_repeat = 4

    def __init__(self, robot: RobotLike = "rover_zero") -> None:
        super().__init__()
        self._robot, self.made_for = get_robot(robot), beams_and_contacts(robot)
        self.in_keys = ["lidar", "imu", ROUTE] + ([] if self._robot.drive.turns_in_place else ["velocities"])
        self.out_keys = ["action"]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        lidar, imu, route = (tensordict[key] for key in self.in_keys[:3])
        scan_pose = tensordict.get(SCAN_POSE, None)
        if self._robot.drive.turns_in_place:
            return tensordict.set("action", follow(lidar, imu, route, Follower.of(self._robot), scan_pose))
        numbers, velocities = RobotNumbers.of_robot(self._robot, lidar), tensordict["velocities"]
        return tensordict.set("action", follow_in_arcs(lidar, imu, route, velocities, numbers, scan_pose))


class MovingGridPlanner(GridPlanner):
    """The :class:`GridPlanner` with routes around what moves: :class:`~rover_rl.envs.sensors.movers.Movers`."""

    def __init__(self, robot: RobotLike = "rover_zero") -> None:
        super().__init__(robot)
        self.in_keys.append(MOVERS)


def beams_and_contacts(robot: RobotLike) -> EnvConfig:
    """Returns an environment with one lidar reading for each beam, whose episodes end when the body touches something.

    In narrow gaps, readings are below the contract's threshold.
    """
    lidar, task = LidarConfig(), TaskConfig(collision_from="contact", collision_window=0)
    return EnvConfig(robot=robot, lidar=replace(lidar, points=lidar.beams), task=task)


def follow_in_arcs(
    lidar: Tensor, imu: Tensor, route: Tensor, velocities: Tensor, robot: RobotNumbers, scan_pose: Tensor | None = None
) -> Tensor:
    """Computes the action of robots that cannot turn in place, which follow their routes in arcs.

    It begins the arc from which the way to a place on the route ahead is the shortest. From a slope that is too steep,
    it backs down straight. Arguments and action are those of :func:`follow`, ``[N, ...]``, with ``velocities [N, 2]``,
    forward speed (m/s) and yaw rate of the wheels, and values of the sensor ``robot``, ``[N, 1]`` each.
    """
    place = way_point(route, AHEAD * robot.min_radius)
    action = drive_to(place, route[:, 4:], lidar, velocities, robot, scan_pose)
    steep = imu[:, :1] < -STEEP
    return torch.where(steep, torch.tensor((BACK_DOWN, 0.0), device=action.device), action)


class Follower(NamedTuple):
    """What :func:`follow` needs to know of a robot.

    Attributes:
        back, front: x of both ends of the footprint, m.
        half_width: half of its width, m.
        lidar_x: x of the lidar, m.
        turn_gain: heading offset for each radian to turn.
    """

    front: float
    back: float
    half_width: float
    lidar_x: float
    turn_gain: float

    @classmethod
    def of(cls, robot: Robot) -> Follower:
        outline = robot.footprint
        return cls(outline.front, outline.back, outline.half_width, robot.lidar_position[0], turn_gain(robot))


def follow(lidar: Tensor, imu: Tensor, route: Tensor, robot: Follower, scan_pose: Tensor | None = None) -> Tensor:
    """Computes the action of a rover that follows its route.

    The heading offset is twice the angle to the first corner of the route for Rover Zero, and less for a robot that
    turns faster. The speed decreases as the angle grows and as obstacles in the lane ahead get closer. In front of an
    obstacle, the rover backs off while it turns. On a slope, it does not turn on the spot, but in a slow curve. From a
    slope that is too steep, it backs down straight.

    Args:
        lidar, imu, route: entries of the observation, ``[..., n]``.
        robot: robot whose footprint must stay free, and which turns in place.
        scan_pose: where the scan was taken, ``[..., 6]``. ``None``: where the rover is.

    Returns:
        Action ``[..., 2]``: forward speed (m/s) and heading offset (rad).
    """
    angle = route[..., 1:2]
    x, y = hit_points(lidar, robot.lidar_x, scan_pose=scan_pose)
    aside = y.abs() > robot.half_width + MARGIN
    ahead = x.masked_fill(aside | (x < 0), math.inf).amin(-1, keepdim=True) - robot.front
    behind = (-x).masked_fill(aside | (x > 0), math.inf).amin(-1, keepdim=True) + robot.back
    allowed = ((ahead - STOP) / SLOW).clamp(CREEP, 1.0)
    speed = angle.cos().clamp(min=0).square() * allowed
    sloped = imu[..., :2].norm(dim=-1, keepdim=True) > SLOPE
    speed = torch.where(sloped & (angle.abs() > SHARP), SLOPE_SPEED * allowed, speed)
    speed = torch.where(ahead < STOP, torch.where(behind > BEHIND, BACK_OFF, 0.0), speed)
    speed = torch.where(~sloped & (angle.abs() > TURN), speed.clamp(max=0), speed)
    # A positive pitch is nose down.
    steep = imu[..., :1] < -STEEP
    speed = torch.where(steep, BACK_DOWN, speed)
    turn = torch.where(steep, 0.0, robot.turn_gain * angle)
    return torch.cat((speed, turn.clamp(-math.pi, math.pi)), -1)


def way_point(route: Tensor, ahead: Tensor | float) -> Tensor:
    """Returns the place on routes ``[N, 5]`` at most ``ahead`` (m) along them, in the base frame: ``[N, 2]``, m."""
    far, angle, far_second, angle_second, _ = route.split(1, -1)
    first = far * torch.cat((angle.cos(), angle.sin()), -1)
    leg = far_second * torch.cat((angle_second.cos(), angle_second.sin()), -1) - first
    share = ((ahead - far).clamp(min=0) / leg.norm(dim=-1, keepdim=True).clamp(min=1e-6)).clamp(max=1)
    return first * (ahead / far.clamp(min=1e-6)).clamp(max=1) + share * leg
