"""Robots of the family ``any`` drive as their numbers say."""

from __future__ import annotations

import torch

from rover_rl.robots import get_robots
from rover_rl.robots.fleet import Fleet
from rover_rl.rotations import quaternion_to_euler
from rover_rl.sims import make_simulator
from rover_rl.worlds import Terrain, World

ROBOTS = get_robots("any:0-63")
FLAT = World("flat", Terrain.flat((60.0, 60.0)))


def driven(commands: torch.Tensor, seconds: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Returns the speed and the yaw rate of each robot in the last second, ``[N]`` each."""
    fleet = Fleet(ROBOTS, torch.arange(len(ROBOTS)))
    simulator = make_simulator("warp", worlds=[FLAT] * len(ROBOTS), robot=fleet)
    simulator.reset(torch.ones(len(ROBOTS), dtype=torch.bool), torch.zeros(len(ROBOTS), 3))
    states = [simulator.step(commands) for _ in range(int(20 * seconds))]
    simulator.close()
    first, last = states[-21], states[-1]
    yaws = torch.stack([quaternion_to_euler(each.orientation)[:, 2] for each in states[-21:]])
    turned = torch.remainder(yaws.diff(dim=0) + torch.pi, 2 * torch.pi) - torch.pi
    assert last.position[:, 2].abs().max() < 0.02
    return (last.position - first.position).norm(dim=-1), turned.sum(0)


def test_robots_reach_their_speed():
    commands = torch.tensor([[robot.drive.max_speed, 0.0] for robot in ROBOTS])
    speed, rate = driven(commands, 4)
    assert ((speed / commands[:, 0] - 1).abs() < 0.02).all()
    assert (rate.abs() < 0.02).all()


def test_skid_steers_turn_in_place_and_cars_on_their_smallest_radius():
    cars = torch.tensor([not robot.drive.turns_in_place for robot in ROBOTS])
    commands = torch.tensor([[0.0, 0.8] if robot.drive.turns_in_place else [0.3, 3.0] for robot in ROBOTS])
    _, rate = driven(commands, 3)
    # A controller knows the slip of its wheels up to a tenth.
    assert ((rate / 0.8 - 1).abs()[~cars] < 0.2).all()
    radius = torch.tensor([robot.drive.min_radius(robot.wheels) for robot in ROBOTS])
    assert ((0.3 / rate / radius - 1).abs()[cars] < 0.05).all()
