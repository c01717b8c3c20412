"""Kinematics and acceleration limits of drives."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from rover_rl.robots import get_robot
from rover_rl.robots.fleet import Fleet
from rover_rl.robots.kinematics import Kinematics
from rover_rl.sims.rover_state import SimulatedDrives
from tests.robots.drives.vehicles import TRACK, WHEELBASE, make_car, make_omni

ROVER = get_robot("rover_zero")
SPEED = st.floats(-3, 3)


def kinematics(robot, dt=0.05):
    return Kinematics(Fleet.of(robot, 1), dt)


@settings(deadline=None)
@given(SPEED, SPEED, SPEED, SPEED)
def test_a_skid_steer_keeps_its_accelerations_and_reports_its_twist(v0, w0, v1, w1):
    drive, current, command = kinematics(ROVER), torch.tensor([[v0, w0]]), torch.tensor([[v1, w1]])
    after = drive.advance(current, command)
    assert ((after - current).abs() <= torch.tensor([[5.0 * 0.05, 4.0 * 0.05]]) + 1e-6).all()
    assert ((command - after).abs() <= (command - current).abs() + 1e-6).all()
    torch.testing.assert_close(drive.odometry(drive.joints(after, after)), after, atol=1e-5, rtol=1e-5)


def test_wheel_speeds_follow_the_separation_that_is_stated_or_that_of_the_hubs():
    twist = torch.tensor([[1.0, 2.0]])
    speeds = kinematics(ROVER).joints(twist, twist).speeds
    torch.testing.assert_close(speeds, torch.tensor([[(1 - 0.24) / 0.122, (1 + 0.24) / 0.122]]))
    hubs = replace(ROVER, drive=replace(ROVER.drive, separation=None))
    torch.testing.assert_close(kinematics(hubs).joints(twist, twist).speeds, torch.tensor([[0.64, 1.36]]) / 0.122)


def test_front_wheels_of_a_car_turn_by_the_angles_of_its_geometry(tmp_path):
    drive, curvature = kinematics(make_car(tmp_path, max_steering_rate=100.0)), 0.8
    after = drive.advance(torch.zeros(1, 2), torch.tensor([[0.1, 0.1 * curvature]]))
    targets = drive.joints(after, after)
    expected = [math.atan(WHEELBASE / (1 / curvature - TRACK / 2)), math.atan(WHEELBASE / (1 / curvature + TRACK / 2))]
    assert targets.angles[0].tolist() == pytest.approx(expected, rel=1e-4)
    assert drive.odometry(targets)[0].tolist() == pytest.approx([0.1, 0.1 * curvature], rel=1e-4)


def test_drives_of_all_kinds_in_one_batch_move_their_joints_as_alone(tmp_path):
    cars = [make_car(tmp_path), make_car(tmp_path, max_steering=0.3, max_linear_acceleration=1.0)]
    robots = [ROVER, *cars, make_omni(tmp_path), get_robot("husky")]
    index = torch.tensor([0, 1, 2, 3, 4, 2, 0])
    together = SimulatedDrives(Fleet(robots, index), 0.05)
    alone = [SimulatedDrives(Fleet.of(robots[k], 1), 0.05) for k in index]
    generator = torch.Generator().manual_seed(0)
    for _ in range(20):
        commands = 2 * torch.rand(len(index), 2, generator=generator) - 0.5
        joints = together.advance(commands, None)
        state = together.state(torch.cat((torch.zeros(len(index), 7), joints.speeds, joints.angles), -1))
        for row, drives in enumerate(alone):
            mine, drive = drives.advance(commands[row : row + 1], None), robots[index[row]].drive
            assert torch.equal(joints.speeds[row, : len(drive.motors)], mine.speeds[0])
            assert torch.equal(joints.angles[row, : len(drive.steering)], mine.angles[0])
            own = drives.state(torch.cat((torch.zeros(1, 7), mine.speeds, mine.angles), -1))
            assert torch.equal(state.linear_velocity[row], own.linear_velocity[0])
            assert torch.equal(state.angular_velocity[row], own.angular_velocity[0])
