"""Robots of the family ``any`` drive as their numbers say."""

from __future__ import annotations

import torch

from rover_rl.robots import get_robots
from rover_rl.robots.fleet import Fleet
from rover_rl.rotations import quaternion_to_euler
from rover_rl.sims import make_simulator
from rover_rl.worlds import Terrain, World

ROBOTS = get_robots("any:0-31")
FLAT = World("flat", Terrain.flat((60.0, 60.0)))


def test_robots_reach_their_speed_and_turn_in_place_or_on_their_smallest_radius():
    count, cars = len(ROBOTS), torch.tensor([not robot.drive.turns_in_place for robot in ROBOTS])
    straight = [[robot.drive.max_speed, 0.0] for robot in ROBOTS]
    turning = [[0.0, 0.8] if robot.drive.turns_in_place else [0.3, 3.0] for robot in ROBOTS]
    fleet = Fleet(ROBOTS, torch.arange(count).repeat(2))
    simulator = make_simulator("warp", worlds=[FLAT] * 2 * count, robot=fleet)
    simulator.reset(torch.ones(2 * count, dtype=torch.bool), torch.zeros(2 * count, 3))
    states = [simulator.step(torch.tensor(straight + turning)) for _ in range(70)]
    simulator.close()
    assert states[-1].position[:, 2].abs().max() < 0.02
    # In the last second.
    speed = (states[-1].position - states[-21].position).norm(dim=-1)[:count]
    yaws = torch.stack([quaternion_to_euler(each.orientation)[:, 2] for each in states[-21:]])
    ahead, rate = (torch.remainder(yaws.diff(dim=0) + torch.pi, 2 * torch.pi) - torch.pi).sum(0).split(count)
    assert ((speed / torch.tensor(straight)[:, 0] - 1).abs() < 0.02).all()
    assert (ahead.abs() < 0.02).all()
    # A controller knows the slip of its wheels up to a tenth.
    assert ((rate / 0.8 - 1).abs()[~cars] < 0.2).all()
    radius = torch.tensor([robot.drive.min_radius(robot.wheels) for robot in ROBOTS])
    assert ((0.3 / rate / radius - 1).abs()[cars] < 0.05).all()
