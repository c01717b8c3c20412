"""How robots with each kind of drive move in every simulator, compared with the geometry."""

from __future__ import annotations

import math

import pytest
import torch

from rover_rl.robots import Robot
from rover_rl.rotations import quaternion_to_euler
from tests.robots.drives.vehicles import WHEELBASE, make_car, make_omni, make_pair
from tests.sims import driven
from tests.sims.driven import FLAT, ROVER, placed

DT = 0.05


def drive(backend, robot, commands, settle=40, steps=20):
    """Returns poses (x, y, yaw) ``[steps + 1, N, 3]`` and the last state of rovers that hold their commands."""
    simulator = placed(backend, FLAT, torch.zeros(len(commands), 3), robot)
    states = driven.drive(simulator, commands, settle + steps)[settle - 1 :]
    simulator.close()
    yaws = [quaternion_to_euler(state.orientation)[:, 2:] for state in states]
    poses = [torch.cat((state.position[:, :2], yaw), -1) for state, yaw in zip(states, yaws, strict=True)]
    return torch.stack(poses).double(), states[-1]


def twist(poses, ahead=0.0):
    """Returns the mean forward speed, yaw rate and leftward speed ``[N]`` of a point ``ahead`` of the origin."""
    yaw = poses[..., 2]
    point = poses[..., :2] + ahead * torch.stack((yaw.cos(), yaw.sin()), -1)
    turn = torch.remainder(yaw[1:] - yaw[:-1] + math.pi, 2 * math.pi) - math.pi
    chord, middle = point[1:] - point[:-1], yaw[:-1] + turn / 2
    # An arc is longer than its chord.
    arc = torch.where(turn.abs() > 1e-6, (turn / 2) / (turn / 2).sin(), torch.ones_like(turn)) / DT
    forward = (chord[..., 0] * middle.cos() + chord[..., 1] * middle.sin()) * arc
    left = (chord[..., 1] * middle.cos() - chord[..., 0] * middle.sin()) * arc
    return forward.mean(0), (turn / DT).mean(0), left.mean(0)


def within(actual, expected, share=0.02, floor=0.01):
    torch.testing.assert_close(
        actual.double(), torch.as_tensor(expected, dtype=torch.float64), rtol=share, atol=floor * share
    )


def test_a_car_turns_about_the_center_of_its_geometry(backend, tmp_path):
    car = make_car(tmp_path)
    curvatures = torch.tensor([0.3, -0.8, 1.0, 1.5], dtype=torch.float64)
    speeds = torch.tensor([0.8, 0.8, -0.5, 0.6], dtype=torch.float64)
    commands = torch.stack((speeds, speeds * curvatures), -1).float()
    poses, state = drive(backend, car, commands.tolist())
    # The sharpest turn: radius 0.915 m.
    curvatures[3] = 1 / car.drive.min_radius(car.wheels)
    forward, rate, _ = twist(poses, ahead=-WHEELBASE / 2)
    within(forward / rate, 1 / curvatures)
    within(forward, speeds)
    within(state.linear_velocity.squeeze(-1), forward)
    within(state.angular_velocity.squeeze(-1), rate)


def test_a_car_does_not_turn_in_place(backend, tmp_path):
    poses, _ = drive(backend, make_car(tmp_path), [[0.0, 2.0]])
    assert (poses[-1, 0] - poses[0, 0]).abs().max() < 0.01


def test_an_omnidirectional_robot_moves_in_every_direction(backend, tmp_path):
    omni = make_omni(tmp_path)
    commands = [[0.6, 0.0, 0.0], [0.0, 0.0, 0.5], [0.3, 0.0, -0.4], [0.0, 1.0, 0.0], [0.3, 0.5, 0.4]]
    poses, state = drive(backend, omni, commands)
    motion = torch.stack(twist(poses), -1)
    within(motion, commands, floor=0.5)
    reported = torch.cat((state.linear_velocity, state.angular_velocity, state.lateral_velocity), -1)
    within(reported, commands, floor=0.5)


def test_an_omnidirectional_robot_takes_commands_without_a_sideways_speed(tmp_path):
    poses, _ = drive("warp", make_omni(tmp_path), [[0.5, 0.0]])
    within(torch.stack(twist(poses), -1), [[0.5, 0.0, 0.0]], floor=0.5)


def test_casters_carry_a_robot_and_do_not_hold_it(backend, tmp_path):
    pair = make_pair(tmp_path)
    commands = torch.tensor([[0.6, 0.0], [0.0, 1.0], [0.5, 0.8], [-0.4, 0.5]], dtype=torch.float64)
    poses, state = drive(backend, pair, commands.tolist())
    forward, rate, left = twist(poses)
    within(forward, commands[:, 0], floor=0.5)
    within(rate, commands[:, 1], floor=0.5)
    within(left, torch.zeros(4), floor=0.5)
    within(state.linear_velocity.squeeze(-1), commands[:, 0], floor=0.5)
    assert quaternion_to_euler(state.orientation)[:, :2].abs().max() < 0.01


def test_a_rover_with_spheres_for_wheels_drives_and_turns(backend, tmp_path):
    cylinder = '<cylinder radius="0.122" length="0.09"/></geometry>\n    </collision>'
    text = ROVER.urdf.read_text()
    assert cylinder in text
    urdf = tmp_path / "spheres.urdf"
    urdf.write_text(text.replace(cylinder, '<sphere radius="0.122"/></geometry>\n    </collision>'))
    spheres = Robot.from_urdf(urdf, drive=ROVER.drive)
    # The spheres reach 0.122 m to the sides of their hubs.
    assert spheres.footprint.half_width == pytest.approx(0.18 + 0.122)
    poses, _ = drive(backend, spheres, [[0.5, 0.0], [0.0, 1.0]])
    forward, rate, _ = twist(poses)
    within(forward[:1], [0.5])
    assert rate[1] > 0.2


def test_no_drive_depends_on_its_company(backend, tmp_path):
    cases = (
        (make_car(tmp_path), [0.6, 0.4]),
        (make_omni(tmp_path), [0.3, 0.4, 0.2]),
        (make_pair(tmp_path), [0.5, 0.4]),
    )
    for robot, command in cases:
        alone, _ = drive(backend, robot, [command], settle=5, steps=5)
        among, _ = drive(backend, robot, [[-x for x in command], command, command], settle=5, steps=5)
        assert torch.equal(alone[:, 0], among[:, 1])
