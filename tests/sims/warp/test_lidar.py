"""Warp's lidar against a plain one, and against Bullet's rays, in every world and tilted up to 30 degrees."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from rover_rl.sims import make_simulator
from rover_rl.sims.robots import get_robot
from rover_rl.sims.worlds import World, get_world
from tests.sims.warp.dda import scan as plain_scan

pytest.importorskip("warp", reason="needs rover_rl[warp]")

from rover_rl.sims.bullet.lidar import Lidar

ROVER = get_robot("rover_zero")
WORLDS = ("inspect", "moon", "maze", "maze:3")


def poses(world: World, count: int) -> tuple[np.ndarray, Rotation]:
    """Base frames anywhere in a world, near the ground, tilted up to 30 degrees any way."""
    rng = np.random.default_rng(0)
    (x_low, x_high), (y_low, y_high) = world.bounds
    position = np.stack((rng.uniform(x_low, x_high, count), rng.uniform(y_low, y_high, count), np.zeros(count)), -1)
    position[:, 2] = world.height_at(torch.from_numpy(position[:, :2])).numpy() + rng.uniform(-0.02, 0.3, count)
    tilt, azimuth, yaw = rng.uniform((0, 0, 0), (math.radians(30), 2 * math.pi, 2 * math.pi), (count, 3)).T
    leaning = Rotation.from_rotvec(np.stack((np.cos(azimuth) * tilt, np.sin(azimuth) * tilt, 0 * tilt), -1))
    return position.astype(np.float32), leaning * Rotation.from_euler("z", yaw[:, None])


def warp_scan(world: World, position: np.ndarray, rotation: Rotation, beams: int) -> np.ndarray:
    simulator = make_simulator("warp", worlds=[world] * len(position), robot=ROVER, lidar_beams=beams)
    return simulator.scan_from(torch.from_numpy(position), torch.from_numpy(rotation.as_quat())).numpy()


@pytest.mark.parametrize("name", WORLDS)
def test_it_agrees_with_bullets_rays(name):
    world = get_world(name)
    position, rotation = poses(world, 64)
    angles = np.arange(640) * (2 * math.pi / 640)
    expected = Lidar(world, ROVER, angles).scan(position.astype(float), rotation.as_matrix())
    found = warp_scan(world, position, rotation, 640)
    reach = ROVER.lidar_range
    wrong = np.abs(np.minimum(found, reach) - np.minimum(expected, reach)) > 0.01
    assert wrong.mean() <= 0.001
    # Both say alike where the lidar is inside something, which the poses have some of.
    assert ((found == 0).all(1) == (expected == 0).all(1)).all()


@pytest.mark.parametrize("beams", [8, 20, 100])
@pytest.mark.parametrize("name", WORLDS)
def test_few_beams_see_what_many_do(name, beams):
    world = get_world(name)
    position, rotation = poses(world, 64)
    few, many = (warp_scan(world, position, rotation, count) for count in (beams, 8 * beams))
    reach = ROVER.lidar_range
    wrong = np.abs(np.minimum(few, reach) - np.minimum(many[:, ::8], reach)) > 0.01
    assert wrong.mean() <= 0.001


@pytest.mark.parametrize("name", WORLDS)
def test_it_agrees_with_a_plain_lidar(name):
    world = get_world(name)
    position, rotation = poses(world, 12)
    origins = position + rotation.apply(ROVER.lidar_position)
    found = warp_scan(world, position, rotation, 32)
    outside = ~world.inside(torch.from_numpy(origins)).numpy()
    assert outside.sum() >= 6
    for row in np.flatnonzero(outside):
        expected = plain_scan(world, origins[row], rotation[row].as_matrix(), 32, ROVER.lidar_range)
        np.testing.assert_allclose(found[row], expected, atol=0.01)
