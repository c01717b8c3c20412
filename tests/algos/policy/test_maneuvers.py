"""Maneuvers of a car: arcs forward and backward, chosen by where they end."""

from __future__ import annotations

import math

import pytest
import torch

from rover_rl.algos.policy.maneuvers import Maneuvers, way_point
from rover_rl.envs.config import HeadingGains
from rover_rl.sims.robots.footprint import footprint
from tests.fleet import hunter, racer

OPEN, RANGE, BEAMS = 12.0, 12.0, 128


def readings(robot, points):
    """Readings of a lidar for points in the base frame, one beam each; nothing elsewhere."""
    lidar = torch.full((1, BEAMS), OPEN)
    for x, y in points:
        dx, dy = x - robot.lidar_position[0], y - robot.lidar_position[1]
        beam = round(math.atan2(dy, dx) / (2 * math.pi) * BEAMS - 0.5) % BEAMS
        lidar[0, beam] = math.hypot(dx, dy)
    return lidar


def choose(robot, place, lidar, speed=0.0, length=2.0):
    maneuvers = Maneuvers(robot)
    place, length, speed = torch.tensor([place]), torch.tensor([[length]]), torch.tensor([[speed]])
    action = maneuvers.towards(place, length, lidar, RANGE, speed)
    return action[0].tolist()


@pytest.mark.parametrize("make", [racer, hunter])
def test_no_arc_is_sharper_than_the_robot_turns_and_poses_are_those_of_a_car(make):
    robot = make()
    maneuvers, radius = Maneuvers(robot), robot.drive.min_radius(robot.wheels)
    poses = maneuvers.poses
    curvature = maneuvers._tensors["curvature"]
    assert curvature.abs().max() * radius < 1
    # A single arc forward at the sharpest curvature: the pivot is on a circle about a point beside it.
    sharp = (maneuvers._tensors["gear"] > 0) & (curvature == curvature.max()) & (poses.gear > 0)
    first = sharp.nonzero()[:6, 0]
    center = torch.tensor([robot.drive.pivot(robot.wheels), maneuvers.radius])
    away = torch.hypot(poses.x_pivot[first] - center[0], poses.y_pivot[first] - center[1])
    assert torch.allclose(away, torch.full_like(away, maneuvers.radius), atol=1e-5)


def test_it_drives_to_a_place_ahead_straight_to_one_beside_in_a_curve_and_backs_off_from_a_wall():
    speed, offset = choose(racer(), (2.0, 0.0), torch.full((1, BEAMS), OPEN))
    assert (speed, offset) == (1.0, 0.0)
    speed, offset = choose(racer(), (1.5, 1.0), torch.full((1, BEAMS), OPEN))
    assert speed > 0.5
    assert offset > 0.1
    wall = [(0.3, y / 10) for y in range(-12, 13)]
    speed, offset = choose(racer(), (-0.5, 1.5), readings(racer(), wall))
    assert speed < 0


def test_it_goes_on_in_its_direction_unless_the_other_is_worth_the_change():
    lidar = torch.full((1, BEAMS), OPEN)
    beside = (0.0, 1.0)
    forward, backward = (choose(racer(), beside, lidar, speed)[0] for speed in (0.6, -0.4))
    assert forward > 0 or backward < 0
    assert choose(racer(), (3.0, 0.0), lidar, -0.4)[0] > 0


def test_no_chosen_arc_touches_what_the_lidar_sees():
    robot, outline = hunter(), footprint(hunter())
    generator = torch.Generator().manual_seed(0)
    maneuvers = Maneuvers(robot)
    lidar = 1.2 + 2 * torch.rand(64, BEAMS, generator=generator)
    hits = maneuvers.hits(lidar, RANGE)
    free = maneuvers.free(maneuvers.clearances(hits))
    assert 0.1 < free.float().mean() < 0.9
    poses = maneuvers.poses
    dx, dy = hits[:, None, :, 0] - poses.x[:, None], hits[:, None, :, 1] - poses.y[:, None]
    cos, sin = poses.heading.cos()[:, None], poses.heading.sin()[:, None]
    ahead, aside = dx * cos + dy * sin, dy * cos - dx * sin
    inside = (ahead < outline.front) & (ahead > outline.back) & (aside.abs() < outline.half_width)
    assert not (inside.any(-1) & free).any()


def test_a_speed_commands_the_curvature_of_the_arc():
    speed, offset = choose(racer(), (0.2, 2.0), torch.full((1, BEAMS), OPEN))
    assert abs(offset * HeadingGains.kp / speed) * racer().drive.min_radius(racer().wheels) <= 1


def test_the_place_on_a_route_is_that_far_along_it():
    route = torch.tensor([[2.0, 0.0, math.hypot(2, 1), math.atan2(1, 2), 3.0]])
    for ahead, place in {1.5: (1.5, 0.0), 2.5: (2.0, 0.5), 9.0: (2.0, 1.0)}.items():
        assert torch.allclose(way_point(route, ahead), torch.tensor([place]), atol=1e-5)
