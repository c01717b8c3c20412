"""The sensor ``past_scans``: earlier scans from where the rover is now."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from rover_rl import RoverEnv
from rover_rl.algos.policy.dwa import LIDAR
from rover_rl.envs.config import EnvConfig
from rover_rl.envs.sensors.past_scans import PastScans
from rover_rl.worlds import Terrain, World, box
from rover_rl.worlds.movers import Box, Mover, Waypoints

SENSOR = PastScans(count=2, apart=5, points=64)
AGES = 0.25, 0.5
"""How old the two scans are, s."""
FACE = 5.0
"""Distance of a wall from the start, m."""


def driven(yaw: Tensor, world: World, speed: float, sensor: PastScans = SENSOR, steps: int = 20) -> Tensor:
    """Drives at a speed, and returns the range straight ahead in the scan now and in the past ones, ``[N, 3]``, m."""
    env = RoverEnv(EnvConfig(world=world, num_envs=len(yaw), backend="warp", lidar=LIDAR, sensors=[sensor], seed=3))
    start = torch.cat((torch.zeros(len(yaw), 2), yaw[:, None]), -1)
    tensordict = env.reset(start=start, goal=torch.tensor([[0.0, 8.0]]).repeat(len(yaw), 1))
    first = tensordict["past_scans"].unflatten(-1, (3, 64))
    assert torch.equal(first, first[:, :1].expand(-1, 3, -1))
    for _ in range(steps):
        action = torch.stack((torch.full_like(yaw, speed), torch.zeros_like(yaw)), -1)
        tensordict = env.step(tensordict.set("action", action))["next"]
    env.close()
    ranges = tensordict["past_scans"].unflatten(-1, (3, 64))[..., 0]
    torch.testing.assert_close(ranges[:, 0], tensordict["lidar"][:, 0], atol=0.05, rtol=0)
    return ranges


def test_what_rests_has_the_same_range_in_all_scans() -> None:
    walls = World("wall", Terrain.flat((20.0, 20.0)), [box((FACE, 0, 1), (0.2, 8, 2))])
    ranges = driven(torch.tensor([0.0, 0.1]), walls, speed=1.0)
    # They have come closer by 0.7 m or more.
    assert (ranges[:, 0] < FACE - 0.7).all()
    torch.testing.assert_close(ranges[:, 1:], ranges[:, :1].expand(-1, 2), atol=0.05, rtol=0)


def test_a_long_wall_that_moves_was_elsewhere() -> None:
    path = Waypoints([(0.0, FACE, 0.0, 0.0), (4.0, FACE - 4.0, 0.0, 0.0)], "once")
    world = World("sliding", Terrain.flat((20.0, 20.0)), movers=[Mover(path, Box(0.2, 4.0, 1.0))])
    ranges = driven(torch.tensor([0.0, 0.05]), world, speed=0.0)
    torch.testing.assert_close(ranges[:, 1:] - ranges[:, :1], torch.tensor([AGES]).expand(2, 2), atol=0.03, rtol=0)
    assert torch.equal(driven(torch.tensor([0.0]), world, speed=0.0), ranges[:1])
    # As training reads it, the scans are as old.
    assert torch.equal(driven(torch.tensor([0.0]), world, 0.0, replace(SENSOR, period=5)), ranges[:1])
    with pytest.raises(ValueError, match="^apart of sensor 'past_scans' must be a multiple of its period, 4 steps"):
        replace(SENSOR, period=4)


def test_networks_read_what_has_changed() -> None:
    now, before, both = torch.full((64,), 2.0), torch.full((64,), 3.0), torch.full((64,), 2.0)
    before[:8] = 2.0
    encoded = SENSOR.encode(torch.cat((now, before, both))).unflatten(-1, (3, 64))
    assert SENSOR.features == 192
    assert not encoded[2].any()
    # The direction ahead is in the middle of the row.
    changed = encoded[1] != 0
    assert not changed[32:40].any()
    assert (encoded[1, changed] == -1).all()
    assert changed.sum() == 56


def test_the_mirror_image_swaps_left_and_right() -> None:
    value = torch.arange(192.0)
    mirrored = SENSOR.mirror(value)
    assert torch.equal(SENSOR.mirror(mirrored), value)
    assert mirrored[:4].tolist() == [0, 63, 62, 61]
    assert mirrored[64:67].tolist() == [64, 127, 126]
