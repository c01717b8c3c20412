"""Warp's lidar compared with Bullet's rays, in every world, tilted up to 30 degrees."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from rover_rl.native.warp import wp
from rover_rl.robots import get_robot
from rover_rl.robots.fleet import Fleet
from rover_rl.sims.bullet.simulator import BulletLidar
from rover_rl.sims.scenes.scene import Scene
from rover_rl.sims.scenes.table import SceneTable
from rover_rl.sims.warp.kernels.lidar import scan, scan_share
from rover_rl.sims.warp.kernels.scan_plane import SECTORS
from rover_rl.sims.warp.kernels.types import RobotModel, RoverArrays
from rover_rl.sims.warp.models import ModelTable, StateBuffers
from rover_rl.worlds import World, get_world

ROVER = get_robot("rover_zero")
WORLDS = ("inspect", "moon", "maze")


def poses(world: World, count: int) -> tuple[np.ndarray, Rotation]:
    """Random poses of the base frame near the ground of a world, tilted up to 30 degrees in any direction."""
    rng = np.random.default_rng(0)
    (x_low, x_high), (y_low, y_high) = world.bounds
    position = np.stack((rng.uniform(x_low, x_high, count), rng.uniform(y_low, y_high, count), np.zeros(count)), -1)
    position[:, 2] = world.height_at(torch.from_numpy(position[:, :2])).numpy() + rng.uniform(-0.02, 0.3, count)
    tilt, azimuth, yaw = rng.uniform((0, 0, 0), (math.radians(30), 2 * math.pi, 2 * math.pi), (count, 3)).T
    leaning = Rotation.from_rotvec(np.stack((np.cos(azimuth) * tilt, np.sin(azimuth) * tilt, 0 * tilt), -1))
    return position.astype(np.float32), leaning * Rotation.from_euler("z", yaw[:, None])


@wp.kernel
def scan_in_order(
    scenes: wp.array[Scene],
    models: wp.array[RobotModel],
    rovers: RoverArrays,
    beams: wp.array[wp.vec2],
    order: wp.array[int],
    lanes: int,
):
    """Scans with the lanes of a rover in a given order; on the CPU, threads run one after another."""
    row, n = wp.tid()
    scan_share(scenes, models, rovers, beams, row, order[n], lanes)


def warp_scan(
    world: World,
    position: np.ndarray,
    rotation: Rotation,
    beams: int,
    lanes: int = 1,
    order: Sequence[int] | None = None,
    scanned: torch.Tensor | None = None,
) -> np.ndarray:
    """Launches the scan kernel for any poses; a simulator scans only from poses that a rover can have."""
    count = len(position)
    fleet = Fleet.of(ROVER, count)
    models = ModelTable(fleet, "cpu")
    buffers = StateBuffers(fleet)
    buffers.tensors["base_state"][:, :3] = torch.from_numpy(position)
    buffers.tensors["base_state"][:, 3:7] = torch.from_numpy(rotation.as_quat())
    rows = torch.ones(count, dtype=torch.bool) if scanned is None else scanned
    ranges = torch.zeros(count, beams).masked_fill(rows[:, None], torch.inf)
    visible = torch.full((count, SECTORS), ROVER.lidar_range)
    angles = np.arange(beams) * (2 * math.pi / beams)
    directions = wp.array(np.stack((np.cos(angles), np.sin(angles)), -1), dtype=wp.vec2, device="cpu")
    table = SceneTable.of_solids(1, models.reach, "cpu")
    table[0] = world
    rovers = buffers.struct(scanned=rows, ranges=ranges, visible=visible)
    inputs = [table.scenes, models.models, rovers, directions]
    if order is None:
        wp.launch(scan, dim=(len(position), lanes), inputs=[*inputs, 0, lanes], device="cpu")
    else:
        order = wp.array(order, dtype=int, device="cpu")
        wp.launch(scan_in_order, dim=(len(position), lanes), inputs=[*inputs, order, lanes], device="cpu")
    return ranges.numpy()


@pytest.mark.parametrize(("name", "beams"), [("inspect", 20), ("moon", 640), ("maze", 640)])
def test_ranges_do_not_depend_on_the_order_of_the_lanes(name, beams):
    world = get_world(name)
    position, rotation = poses(world, 64)
    expected = warp_scan(world, position, rotation, beams, lanes=2)
    assert np.isfinite(expected).any()
    for lanes in (4, 32):
        np.testing.assert_array_equal(warp_scan(world, position, rotation, beams, lanes), expected)
        order = np.random.default_rng(lanes).permutation(lanes)
        np.testing.assert_array_equal(warp_scan(world, position, rotation, beams, lanes, order), expected)
    # A single lane keeps the first of two ranges that differ in the last bit.
    np.testing.assert_allclose(warp_scan(world, position, rotation, beams), expected, rtol=5e-7)


def test_lanes_leave_rovers_alone_that_do_not_scan():
    world = get_world("maze")
    position, rotation = poses(world, 8)
    scanned = torch.arange(8) % 2 == 0
    found = warp_scan(world, position, rotation, 32, lanes=4, scanned=scanned)
    expected = warp_scan(world, position, rotation, 32, lanes=4)
    np.testing.assert_array_equal(found[scanned], expected[scanned])
    assert (found[~scanned] == 0).all()


@pytest.mark.parametrize("name", WORLDS)
def test_agrees_with_bullet_rays(name):
    world = get_world(name)
    position, rotation = poses(world, 64)
    angles = np.arange(640) * (2 * math.pi / 640)
    expected = BulletLidar(world, ROVER, angles).scan(position.astype(float), rotation.as_matrix())
    found = warp_scan(world, position, rotation, 640)
    reach = ROVER.lidar_range
    wrong = np.abs(np.minimum(found, reach) - np.minimum(expected, reach)) > 0.01
    assert wrong.mean() <= 0.001
    # Some poses are inside an obstacle or below the ground; both lidars agree on which.
    assert ((found == 0).all(1) == (expected == 0).all(1)).all()
