"""Rovers are placed on the ground as ``rest_on_ground`` says."""

from __future__ import annotations

import pytest
import torch

from rover_rl.robots import get_robots
from rover_rl.robots.fleet import Fleet
from rover_rl.rotations import matrix_to_quaternion
from rover_rl.sims.free_space import rest_on_ground
from rover_rl.sims.warp.simulator import WarpSimulator
from rover_rl.worlds import get_world

ROBOTS = ("rover_zero", "leo", "jackal", "husky", "racer", "hunter")
ROWS = 64


@pytest.mark.parametrize("world_name", ["maze", "moon"])
def test_rovers_stand_where_they_rest(world_name: str) -> None:
    world, robots = get_world(world_name), get_robots(ROBOTS)
    index = torch.arange(ROWS) % len(robots)
    simulator = WarpSimulator([world] * ROWS, Fleet(robots, index))
    generator = torch.Generator().manual_seed(0)
    low, high = (torch.tensor(corner) for corner in zip(*world.bounds, strict=True))
    places = low + (high - low) * torch.rand(ROWS, 2, generator=generator)
    poses = torch.cat((places, (2 * torch.rand(ROWS, 1, generator=generator) - 1) * torch.pi), -1)
    state = simulator.reset(torch.ones(ROWS, dtype=torch.bool), poses)
    simulator.close()
    for robot in range(len(robots)):
        rows = index == robot
        position, rotation = rest_on_ground(world, robots[robot], poses[rows])
        # The kernel computes in float32.
        torch.testing.assert_close(state.position[rows].double(), position, rtol=0, atol=5e-5)
        torch.testing.assert_close(state.orientation[rows].double(), matrix_to_quaternion(rotation), rtol=0, atol=5e-5)
