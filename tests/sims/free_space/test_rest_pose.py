"""Placement of rovers on the ground."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from rover_rl.robots import get_robot
from rover_rl.sims.free_space import rest_on_ground
from rover_rl.sims.free_space.ground import CLEARANCE
from rover_rl.worlds import Terrain, World, get_world

ROVER = get_robot("rover_zero")


def ramp(slope_x: float, slope_y: float) -> World:
    axis = np.linspace(-10, 10, 41)
    y, x = np.meshgrid(axis, axis, indexing="ij")
    return World("ramp", Terrain(slope_x * x + slope_y * y + 3.0, 0.5))


@settings(max_examples=40)
@given(
    slope_x=st.floats(-0.5, 0.5),
    slope_y=st.floats(-0.5, 0.5),
    yaw=st.floats(-math.pi, math.pi),
    x=st.floats(-5, 5),
    y=st.floats(-5, 5),
)
def test_on_a_ramp_the_rover_is_aligned_with_the_plane(slope_x, slope_y, yaw, x, y):
    position, rotation = rest_on_ground(ramp(slope_x, slope_y), ROVER, torch.tensor([[x, y, yaw]], dtype=torch.float64))
    up = np.array([-slope_x, -slope_y, 1.0]) / math.hypot(slope_x, slope_y, 1.0)
    ahead = np.array([math.cos(yaw), math.sin(yaw), slope_x * math.cos(yaw) + slope_y * math.sin(yaw)])
    assert rotation[0, :, 2].numpy() == pytest.approx(up, abs=1e-5)
    assert rotation[0, :, 0].numpy() == pytest.approx(ahead / np.linalg.norm(ahead), abs=1e-5)
    assert (rotation[0] @ rotation[0].T).numpy() == pytest.approx(np.eye(3), abs=1e-9)
    assert torch.linalg.det(rotation[0]).item() == pytest.approx(1.0)
    assert position[0, :2].tolist() == pytest.approx([x, y])
    # Measured along the vertical, the lowest wheel is CLEARANCE above the ground.
    hub_gap = (ROVER.wheels.radius - ROVER.wheels.hubs[0][2]) / up[2]
    expected = 3.0 + slope_x * x + slope_y * y + CLEARANCE + hub_gap
    assert position[0, 2].item() == pytest.approx(expected, abs=1e-5)


def lowest_gap(world: World, position: torch.Tensor, rotation: torch.Tensor) -> torch.Tensor:
    """Returns the minimum height of the wheels' treads above the ground: ``[N]``, m."""
    angle = torch.linspace(0, 2 * math.pi, 181, dtype=torch.float64)
    across = torch.linspace(-ROVER.wheels.width / 2, ROVER.wheels.width / 2, 9, dtype=torch.float64)
    a, w = torch.meshgrid(angle, across, indexing="ij")
    tread = torch.stack((ROVER.wheels.radius * a.cos(), w, ROVER.wheels.radius * a.sin()), -1).reshape(-1, 3)
    hubs = torch.tensor(ROVER.wheels.hubs, dtype=torch.float64)
    body = (hubs[:, None] + tread).reshape(-1, 3)
    points = position[:, None] + body @ rotation.transpose(1, 2)
    return (points[..., 2] - world.height_at(points[..., :2])).amin(1)


@pytest.mark.parametrize("name", ["inspect", "moon"])
def test_on_rough_ground_the_lowest_wheel_touches_the_ground(name):
    world = get_world(name)
    rng = np.random.default_rng(0)
    low, high = np.array(world.spawn_range).T
    poses = np.concatenate((rng.uniform(low, high, (300, 2)), rng.uniform(-math.pi, math.pi, (300, 1))), 1)
    gap = lowest_gap(world, *rest_on_ground(world, ROVER, torch.from_numpy(poses)))
    assert gap.min() > -2e-3
    assert gap.max() < 2e-3


def test_a_pose_does_not_depend_on_the_rest_of_the_batch():
    world = get_world("inspect")
    rng = np.random.default_rng(1)
    poses = torch.from_numpy(rng.uniform((-27, -27, -3), (-19, -19, 3), (64, 3)))
    position, rotation = rest_on_ground(world, ROVER, poses)
    for row in (0, 17, 63):
        alone = rest_on_ground(world, ROVER, poses[row : row + 1])
        assert torch.equal(alone[0][0], position[row])
        assert torch.equal(alone[1][0], rotation[row])
