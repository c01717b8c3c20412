"""Tests specific to MuJoCo: ground, scans and dynamics. Those of every simulator are in ``tests/sims``."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from rover_rl.sims import make_scanner
from rover_rl.sims.free_space import free_space
from rover_rl.sims.rays import aimed_rays
from rover_rl.sims.rover_state import Dynamics
from rover_rl.worlds import Terrain, World, get_world
from tests.sims.driven import FLAT, ROVER, all_rows, drive, in_world, placed, slope

pytest.importorskip("mujoco", reason="needs rover_rl[mujoco]")

from rover_rl.native.mujoco import mujoco
from rover_rl.sims.mujoco import MujocoSettings
from rover_rl.sims.mujoco.model import make_model


def hills() -> World:
    """Rough ground whose triangles differ by centimeters from those of the other diagonal."""
    heights = 0.05 * torch.randn(33, 41, generator=torch.Generator().manual_seed(0))
    return World("hills", Terrain(heights, 0.25, (-4.0, -3.0)))


def test_the_ground_has_the_triangles_of_the_terrain():
    world = hills()
    points = torch.rand(200, 2, generator=torch.Generator().manual_seed(1), dtype=torch.float64) * 7.6 - 3.8
    points[:, 1] = 0.9 * points[:, 1] + 1
    expected = world.height_at(points).numpy()
    model = make_model(ROVER, MujocoSettings(), world)
    data = mujoco.MjData(model)
    # Away from the rays, which would see the rover.
    data.qpos[:3] = (0, 0, -100)
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


@pytest.mark.parametrize("name", ["maze", "moon"])
def test_scans_match_rays_of_mujoco(name):
    world = get_world(name)
    cells = free_space(world, ROVER).spawn_cells
    cells = cells[:: len(cells) // 8]
    poses = torch.cat((cells, 0.8 * torch.arange(len(cells))[:, None]), 1).float()
    simulator = placed("mujoco", world, poses)
    scanner, model = (
        make_scanner(simulator, [world] * len(poses), ROVER, 64),
        make_model(ROVER, MujocoSettings(), world),
    )
    data, hits, angles = mujoco.MjData(model), np.zeros(64, np.int32), scanner.angles.double()
    data.qpos[2] = -100  # away from the rays
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    beams, ranges = torch.stack((angles.cos(), angles.sin(), 0 * angles), -1), np.empty((len(poses), 64))
    for origin, rays, row in zip(*aimed_rays(simulator.state(), ROVER.lidar_position, beams), ranges, strict=True):
        # A ray exactly along the edge of two triangles may miss both, and edges are on round numbers.
        start = origin[0].double().numpy() + np.array((1.3e-6, 0.7e-6, 0.0))
        filters = (None, True, -1, hits, row, None, 64, ROVER.lidar_range)
        mujoco.mj_multiRay(model, data, start, rays.double().numpy().ravel(), *filters)
    ranges[(ranges < 0) | (ranges >= ROVER.lidar_range)] = ROVER.lidar_range
    close = np.abs(scanner.scan().clamp(max=ROVER.lidar_range).numpy() - ranges) < 0.01
    assert close.mean() > 0.999
    assert (ranges < ROVER.lidar_range).any()


# Dynamics


HILL = slope(math.degrees(math.atan(0.3)))
"""A gradient of 0.3."""
START = [(0.0, 0.0, 0.3)]


def dynamics(friction=(1.0, 1.0), chassis_mass=(1.0, 1.0), motor_torque=(1.0, 1.0)):
    return Dynamics(*map(torch.tensor, (friction, chassis_mass, motor_torque)))


def randomized(world, change):
    """Returns two rovers, of which the second has other dynamics."""
    sim = placed(MujocoSettings(), world, START * 2)
    sim.set_dynamics(torch.tensor([False, True]), change)
    sim.reset(all_rows(2), torch.tensor(START * 2))
    return sim


def rest(world, change, steps):
    """Returns the state of two rovers with locked wheels. The first moves as one whose dynamics nobody has set."""
    state = drive(randomized(world, change), (0.0, 0.0), steps)[-1]
    alone = drive(placed(MujocoSettings(), world, START), (0.0, 0.0), steps)[-1]
    assert torch.equal(state.position[0], alone.position[0])
    return state


def test_dynamics_act_on_their_row_alone():
    # Twice the weight of the chassis sinks in deeper by that weight over the stiffness of four wheels.
    state = rest(FLAT, dynamics(chassis_mass=(3.0, 2.0)), 40)
    expected = 7.486 * 9.81 / (4 * MujocoSettings().stiffness)
    assert (state.position[0, 2] - state.position[1, 2]).item() == pytest.approx(expected, rel=0.05)
    # A gradient of 0.3 takes 1.1 N m of each motor; the second rover's have 0.5 N m and cannot hold it.
    state = rest(HILL, dynamics(motor_torque=(9.0, 0.1)), 20)
    assert state.linear_velocity[1].abs() > 0.3
    assert state.linear_velocity[0].abs() < 0.01
    # The coefficient is 0.5 in the first row and 0.2 in the second, and the gradient 0.3.
    moved = rest(HILL, dynamics(friction=(7.0, 0.4)), 20).position[:, :2].norm(dim=-1)
    assert moved[0] < 0.005
    assert moved[1] > 0.1


def test_dynamics_return_to_those_of_the_robot():
    sim = randomized(HILL, dynamics(friction=(1.0, 0.4), chassis_mass=(1.0, 1.3)))
    sim.set_dynamics(all_rows(2), dynamics())
    sim.reset(all_rows(2), torch.tensor(START * 2))
    state = drive(sim, (0.7, 0.4), 20)[-1]
    assert torch.equal(state.position[0], state.position[1])
