"""Physics of the simulators, compared with analytic expectations for the rover."""

from __future__ import annotations

import math

import pytest
import torch

from rover_rl.rotations import quaternion_to_euler
from rover_rl.worlds import Terrain, World
from tests.sims.driven import FLAT, ROVER, WALLED, drive, placed, slope

ORIGIN = [(0.0, 0.0, 0.0)]
DT = 0.05


def yaw_rate(states) -> torch.Tensor:
    """Mean yaw rate of the bodies over the states, rad/s."""
    yaws = torch.stack([quaternion_to_euler(s.orientation)[:, 2] for s in states])
    steps = torch.remainder(yaws[1:] - yaws[:-1] + math.pi, 2 * math.pi) - math.pi
    return steps.mean(0) / DT


def test_commanded_speed_is_reached_on_flat_ground(backend):
    simulator, speeds = placed(backend, FLAT, [(0, 0, 0), (0, 0, 2), (0, 3, -1)]), torch.tensor([1.0, 1.0, 0.5])
    states = drive(simulator, [(1.0, 0.0), (1.0, 0.0), (0.5, 0.0)], 60)
    body = (states[-1].position - states[-21].position).norm(dim=-1) / (20 * DT)
    torch.testing.assert_close(body, speeds, atol=0.0, rtol=0.05)
    torch.testing.assert_close(states[-1].linear_velocity.squeeze(-1), speeds, atol=0.01, rtol=0)


def test_turns_within_its_angular_acceleration_limit_and_odometry_reports_the_wheels_not_the_body(backend):
    states = drive(placed(backend, FLAT, ORIGIN), (0.0, 2.0), 40)
    rates = torch.stack([s.angular_velocity[0, 0] for s in states])
    assert (rates[1:] - rates[:-1]).abs().max() <= ROVER.drive.max_angular_acceleration * DT * 1.1
    assert rates[19:].tolist() == pytest.approx([2.0] * 21, abs=0.05)
    assert yaw_rate(states[20:]).item() < 1.1


AROUND = [0.0, 0.25 * math.pi, 0.5 * math.pi, math.pi]
"""Headings on a slope: ahead, diagonally, across and backwards."""
PLANE = World("plane", Terrain.flat((20, 20)))


@pytest.mark.parametrize(("world", "headings", "axes"), [(slope(15.0), AROUND, 2), (PLANE, [0.3], 3)])
def test_stands_still_for_ten_seconds_without_settling(backend, world, headings, axes):
    simulator = placed(backend, world, [(1.5 * k, 0.0, yaw) for k, yaw in enumerate(headings)])
    placed_at, states = simulator.state(), drive(simulator, (0.0, 0.0), 200)
    assert (states[19].position - placed_at.position).norm(dim=-1).max() < 0.005
    turned = quaternion_to_euler(states[19].orientation) - quaternion_to_euler(placed_at.orientation)
    assert torch.remainder(turned + 1, 2 * math.pi).sub(1).abs().max() < 0.01
    moved = (states[-1].position - states[0].position)[:, :axes].norm(dim=-1)
    assert moved.max() < 0.0004


def test_flipped_rover_reports_its_orientation(backend):
    # Driving off an edge of 1.2 m, the rover pitches nose down and rolls over.
    heights = torch.zeros(41, 41)
    heights[:, :20] = 1.2
    simulator = placed(backend, World("cliff", Terrain(heights, 0.25)), [(-0.8, 0.0, 0.0)])
    tilt = torch.stack([quaternion_to_euler(s.orientation)[0, :2] for s in drive(simulator, (1.0, 0.0), 80)])
    assert (tilt.abs() > 1.48).any()


def test_rovers_pass_through_one_another(backend):
    together = placed(backend, FLAT, [*ORIGIN, *ORIGIN, (0.7, 0.0, math.pi)])
    several = drive(together, [(1.0, 0.0), (1.0, 0.5), (1.0, 0.0)], 20)[-1]
    assert torch.equal(several.position[0], drive(placed(backend, FLAT, ORIGIN), (1.0, 0.0), 20)[-1].position[0])


def test_walls_stop_the_rover(backend):
    last = drive(placed(backend, WALLED, ORIGIN), (1.0, 0.0), 70)[-1]
    # The front of the wheels is 0.2635 m ahead of the base frame.
    tolerance = 0.01 if backend == "mujoco" else 0.05
    assert last.position[0, 0].item() == pytest.approx(2.5 - 0.2635, abs=tolerance)
