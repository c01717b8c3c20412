"""Geometry of the ground and of scans in MuJoCo."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from rover_rl.sims.free_space import free_space
from rover_rl.worlds import Terrain, World, get_world
from tests.sims.driven import ROVER, drive, in_world, placed

pytest.importorskip("mujoco", reason="needs rover_rl[mujoco]")

from rover_rl.native.mujoco import mujoco
from rover_rl.sims.mujoco import MujocoSettings
from rover_rl.sims.mujoco.lidar import MujocoLidar, RayScene
from rover_rl.sims.mujoco.model import make_model


def hills() -> World:
    """Rough ground whose triangles differ by centimeters from those of the other diagonal."""
    heights = 0.05 * torch.randn(33, 41, generator=torch.Generator().manual_seed(0))
    return World("hills", Terrain(heights, 0.25, (-4.0, -3.0)))


def test_the_ground_of_the_wheels_and_of_the_lidar_has_the_triangles_of_the_terrain():
    world = hills()
    points = torch.rand(200, 2, generator=torch.Generator().manual_seed(1), dtype=torch.float64) * 7.6 - 3.8
    points[:, 1] = 0.9 * points[:, 1] + 1
    expected = world.height_at(points).numpy()
    for model in (make_model(ROVER, MujocoSettings(), world), RayScene(world, ROVER.lidar_range).model):
        data = mujoco.MjData(model)
        # Away from the rays, which would see the rover.
        data.qpos[:3] = (0, 0, -100)[: len(data.qpos)]
        mujoco.mj_kinematics(model, data)
        geom, down = np.zeros(1, np.int32), np.array((0.0, 0.0, -1.0))
        origins = [np.array((x, y, 5.0)) for x, y in points.tolist()]
        found = [5 - mujoco.mj_ray(model, data, origin, down, None, True, -1, geom, None) for origin in origins]
        np.testing.assert_allclose(found, expected, atol=1e-5)


def test_wheels_rest_on_the_triangles_of_the_terrain():
    world = hills()
    simulator = placed(MujocoSettings(), world, [(0.4 * k - 2, 0.3 * k - 1, 1.3 * k) for k in range(10)])
    state = drive(simulator, (0.0, 0.0), 30)[-1]
    angle = torch.arange(180, dtype=torch.float64) * math.pi / 90
    # The ground carries each wheel at two circles, width / sqrt(3) apart.
    across = torch.tensor((-0.5, 0.5), dtype=torch.float64) * ROVER.wheels.width / math.sqrt(3)
    rim = ROVER.wheels.radius * torch.stack((angle.sin(), 0 * angle, -angle.cos()), -1)
    rims = rim[:, None] + torch.stack((0 * across, across, 0 * across), -1)
    rims = torch.tensor(ROVER.wheels.hubs, dtype=torch.float64)[:, None] + rims.reshape(-1, 3)
    points = in_world(state, rims.reshape(-1, 3)).reshape(10, *rims.shape)
    gaps = (points[..., 2] - world.height_at(points[..., :2])).amin(-1)
    # A wheel sinks in by half a millimeter under a quarter of the weight. At least two wheels stand on the ground.
    assert gaps.min() > -0.003
    assert (gaps.sort(dim=-1).values[:, 1] < 0.001).all()


@pytest.mark.parametrize("name", ["maze", "inspect"])
def test_scans_match_those_of_bullet(name):
    world = get_world(name)
    cells = free_space(world, ROVER).spawn_cells
    cells = cells[:: len(cells) // 8]
    poses = torch.cat((cells, 0.8 * torch.arange(len(cells))[:, None]), 1).float()
    scans = []
    for backend in ("bullet", "mujoco"):
        simulator = placed(backend, world, poses)
        scans.append(simulator.scanner(64).scan().clamp(max=ROVER.lidar_range))
        simulator.close()
    close = (scans[0] - scans[1]).abs() < 0.01
    assert close.float().mean() > 0.998
    assert (scans[0] < ROVER.lidar_range).any()


def test_rays_along_the_edges_of_triangles_hit_the_ground():
    heights = torch.zeros(41, 41)
    heights[:, 30:] = 3.0
    world = World("step", Terrain(heights, 0.25))
    lidar = MujocoLidar(RayScene(world, ROVER.lidar_range), ROVER, np.zeros(1))
    # Along the lines of the grid, and along the common edge of two tiles.
    positions = np.array([(0.0, y, 0.0) for y in (-1.0, -0.25, 0.0, 0.5)])
    ranges = lidar.scan(positions, np.array([(1.0, 0.0, 0.0, 0.0)] * 4))
    np.testing.assert_allclose(ranges, 2.25 + 0.25 * 0.321 / 3 - 0.174, atol=1e-4)
