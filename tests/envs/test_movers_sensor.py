"""The sensor ``movers``: what moves, where the scans will be, its mirror image, and what the map leaves out."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from rover_rl import RoverEnv
from rover_rl.algos.policy.dwa import LIDAR
from rover_rl.envs.config import EnvConfig
from rover_rl.envs.seen_map.seen_map import SeenMap
from rover_rl.envs.sensors.movers import BEARINGS, COUNT, INSTANTS, NUMBERS, TRACKED, Movers, movers_of, predict_scans
from rover_rl.envs.sensors.route import Route
from rover_rl.worlds import Terrain, World
from rover_rl.worlds.movers import Cylinder, Mover, Waypoints

PERIOD = 2
PASSING = Mover(Waypoints([(0.0, 3.0, -3.0, 1.57), (6.0, 3.0, 3.0, 1.57)]), Cylinder(0.5, 1.0))
"""Passes 3 m ahead of the origin, along y at 1 m/s."""


def parked(yaw: Tensor, steps: int, *sensors: object) -> tuple[RoverEnv, Tensor]:
    """Waits at the origin with given headings beside what passes, and returns the environment and the observation."""
    world = World("passing", Terrain.flat((20.0, 20.0)), movers=[PASSING])
    given = [Movers(period=PERIOD), *sensors]
    env = RoverEnv(EnvConfig(world=world, num_envs=len(yaw), backend="warp", lidar=LIDAR, sensors=given, seed=3))  # type: ignore[arg-type]
    start = torch.cat((torch.zeros(len(yaw), 2), yaw[:, None]), -1)
    tensordict = env.reset(start=start, goal=torch.tensor([[8.0, 0.0]]).repeat(len(yaw), 1))
    for _ in range(steps):
        tensordict = env.step(tensordict.set("action", torch.zeros(len(yaw), 2)))["next"]
    return env, tensordict


def map_leaves_out(env: RoverEnv, tensordict: Tensor) -> bool:
    seen = SeenMap(env.fleet, env.config.lidar)
    seen(tensordict)
    return not (seen.levels()[0] == 0).any()


def predicted(movers: Tensor) -> Tensor:
    scans = torch.empty(len(movers), len(INSTANTS), BEARINGS)
    predict_scans(scans, torch.ones(len(movers), dtype=torch.bool), movers)
    return scans


def test_movers_are_told_in_the_frame_of_each_rover_whatever_its_company() -> None:
    yaw = torch.tensor([0.0, 0.5, -2.0])
    tensordict = parked(yaw, 40)[1]
    movers = movers_of(tensordict["movers"])
    assert ((movers[..., 4] > 0).sum(-1) == 1).all()
    place, velocity, radius = movers[:, 0].split((2, 2, 1), -1)
    cos, sin = yaw.cos(), yaw.sin()
    # After two seconds at 1 m/s it is at (3, -1).
    expected = torch.stack((3 * cos - sin, -3 * sin - cos), -1)
    torch.testing.assert_close(place, expected, atol=0.25, rtol=0)
    torch.testing.assert_close(velocity, torch.stack((sin, cos), -1), atol=0.25, rtol=0)
    assert ((radius > 0.3) & (radius < 0.7)).all()
    assert torch.equal(tensordict["movers"][:1], parked(yaw[:1], 40)[1]["movers"])


def test_predicted_scans_tell_when_what_comes_is_near() -> None:
    movers = torch.zeros(1, COUNT, NUMBERS)
    movers[0, 0] = torch.tensor([4.0, 0.0, -1.0, 0.0, 0.5])
    movers[0, 1] = torch.tensor([0.0, 6.0, 0.0, 0.0, 0.3])
    scans = predicted(movers)[0]
    # It comes from ahead: 4 m less 1 m/s, to its surface.
    assert scans[:, 0].tolist() == pytest.approx([3.0, 2.5, 2.0, 1.0])
    assert scans[:, BEARINGS // 4].tolist() == pytest.approx([5.7] * 4)
    assert (scans[:, BEARINGS // 2] == 12.0).all()


def test_the_mirror_image_is_that_of_mirrored_movers() -> None:
    movers = torch.rand(5, COUNT, NUMBERS, generator=torch.Generator().manual_seed(0)) * 8 - 4
    movers[..., 4] = movers[..., 4].abs() / 4
    sensor, image = Movers(), movers * torch.tensor([1.0, -1.0, 1.0, -1.0, 1.0])
    value, mirrored = (torch.cat((each.flatten(1), predicted(each).flatten(1)), -1) for each in (movers, image))
    torch.testing.assert_close(sensor.mirror(value), mirrored)
    assert torch.equal(sensor.mirror(sensor.mirror(value)), value)


def test_the_map_leaves_out_what_moves_also_in_a_late_scan_and_routes_go_around_it() -> None:
    env, tensordict = parked(torch.zeros(1), 20, Route(period=PERIOD))
    assert not map_leaves_out(env, tensordict.exclude("movers"))
    assert map_leaves_out(env, tensordict)
    # It will cross the way ahead when the rover could be there.
    assert tensordict["route"][0, 1].abs() > math.radians(3)
    # Since a late scan, the rover has driven 0.6 m and turned by 0.5 rad.
    place, velocity, radius = movers_of(tensordict["movers"]).split((2, 2, 1), -1)
    way, cos, sin = torch.tensor([0.6, 0.0, 0.0]), math.cos(0.5), math.sin(0.5)
    turn = torch.tensor([[cos, -sin], [sin, cos]])
    now = torch.cat(((place - way[:2]) @ turn, velocity @ turn, radius), -1)
    late = tensordict.copy().update({"movers": torch.cat((now.flatten(1), tensordict["movers"][:, TRACKED:]), -1)})
    late.update({"pose": tensordict["pose"] + way, "imu": torch.tensor([[0.0, 0.0, 0.5]])})
    late["scan_pose"] = torch.tensor([[-0.6 * cos, 0.6 * sin, 0.0, 0.0, 0.0, -0.5]])
    assert map_leaves_out(env, late)
