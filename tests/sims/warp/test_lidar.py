"""Warp's lidar compared with reference ray casting and with Bullet's rays, in every world, tilted up to 30 degrees."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from rover_rl.sims.bullet.lidar import Lidar
from rover_rl.sims.native.warp import wp
from rover_rl.sims.robots import get_robot
from rover_rl.sims.robots.inertial_model import read_inertial_model
from rover_rl.sims.warp.kernels.lidar import scan
from rover_rl.sims.warp.scene import SceneTable, make_robot_model
from rover_rl.sims.warp.state_buffers import StateBuffers
from rover_rl.sims.worlds import World, get_world
from tests.sims.warp.reference_lidar import scan as reference_scan

ROVER = get_robot("rover_zero")
WORLDS = ("inspect", "moon", "maze", "maze:3")


def poses(world: World, count: int) -> tuple[np.ndarray, Rotation]:
    """Random poses of the base frame near the ground of a world, tilted up to 30 degrees in any direction."""
    rng = np.random.default_rng(0)
    (x_low, x_high), (y_low, y_high) = world.bounds
    position = np.stack((rng.uniform(x_low, x_high, count), rng.uniform(y_low, y_high, count), np.zeros(count)), -1)
    position[:, 2] = world.height_at(torch.from_numpy(position[:, :2])).numpy() + rng.uniform(-0.02, 0.3, count)
    tilt, azimuth, yaw = rng.uniform((0, 0, 0), (math.radians(30), 2 * math.pi, 2 * math.pi), (count, 3)).T
    leaning = Rotation.from_rotvec(np.stack((np.cos(azimuth) * tilt, np.sin(azimuth) * tilt, 0 * tilt), -1))
    return position.astype(np.float32), leaning * Rotation.from_euler("z", yaw[:, None])


def warp_scan(world: World, position: np.ndarray, rotation: Rotation, beams: int) -> np.ndarray:
    """Launches the scan kernel for any poses; a simulator scans only from poses that a rover can have."""
    inertial_model = read_inertial_model(ROVER)
    model = make_robot_model(ROVER, inertial_model, "cpu")
    buffers = StateBuffers(inertial_model, ROVER, len(position), beams, torch.device("cpu"))
    buffers.base_state[:, :3] = torch.from_numpy(position)
    buffers.base_state[:, 3:7] = torch.from_numpy(rotation.as_quat())
    angles = np.arange(beams) * (2 * math.pi / beams)
    directions = wp.array(np.stack((np.cos(angles), np.sin(angles)), -1), dtype=wp.vec2, device="cpu")
    table = SceneTable(1, model.bounding_radius, "cpu")
    table[0] = world
    wp.launch(scan, dim=len(position), inputs=[table.scenes, model, buffers.rovers, directions, 0], device="cpu")
    return buffers.ranges.numpy()


@pytest.mark.parametrize("name", WORLDS)
def test_agrees_with_bullet_rays(name):
    world = get_world(name)
    position, rotation = poses(world, 64)
    angles = np.arange(640) * (2 * math.pi / 640)
    expected = Lidar(world, ROVER, angles).scan(position.astype(float), rotation.as_matrix())
    found = warp_scan(world, position, rotation, 640)
    reach = ROVER.lidar_range
    wrong = np.abs(np.minimum(found, reach) - np.minimum(expected, reach)) > 0.01
    assert wrong.mean() <= 0.001
    # Some poses are inside an obstacle or below the ground; both lidars agree on which.
    assert ((found == 0).all(1) == (expected == 0).all(1)).all()


@pytest.mark.parametrize("beams", [8, 20, 100])
@pytest.mark.parametrize("name", WORLDS)
def test_ranges_do_not_depend_on_the_number_of_beams(name, beams):
    world = get_world(name)
    position, rotation = poses(world, 64)
    few, many = (warp_scan(world, position, rotation, count) for count in (beams, 8 * beams))
    reach = ROVER.lidar_range
    wrong = np.abs(np.minimum(few, reach) - np.minimum(many[:, ::8], reach)) > 0.01
    assert wrong.mean() <= 0.001


@pytest.mark.parametrize("name", WORLDS)
def test_agrees_with_reference_ray_casting(name):
    world = get_world(name)
    position, rotation = poses(world, 12)
    origins = position + rotation.apply(ROVER.lidar_position)
    found = warp_scan(world, position, rotation, 32)
    outside = ~world.inside(torch.from_numpy(origins)).numpy()
    assert outside.sum() >= 6
    for row in np.flatnonzero(outside):
        expected = reference_scan(world, origins[row], rotation[row].as_matrix(), 32, ROVER.lidar_range)
        np.testing.assert_allclose(found[row], expected, atol=0.01)
