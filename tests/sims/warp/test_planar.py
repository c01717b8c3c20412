"""The planar tier of the Warp backend, held against the full engine and against the law of friction by hand."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from benchmarks import coulomb
from rover_rl import make_env
from rover_rl.robots import get_robot
from rover_rl.rotations import quaternion_to_euler
from rover_rl.sims.backends import make_scanner
from rover_rl.sims.warp import WarpSettings
from rover_rl.worlds import Terrain, World, box, cylinder, get_world
from tests.robots.drives import vehicles
from tests.sims.driven import placed

LEVEL = World("level", Terrain.flat((200.0, 200.0)))
PLANAR = WarpSettings.preset("planar")
ROBOTS = ("rover_zero", "jackal", "husky", "leo", "hunter")


def driven(settings, robot, commands, world=LEVEL, poses=None):
    """States of rovers that get commands ``[steps, N, 2]``, one after the other."""
    count = commands.shape[1]
    simulator = placed(settings, world, torch.zeros(count, 3) if poses is None else poses, robot)
    for _ in range(3):
        simulator.step(torch.zeros(count, 2))
    states = [simulator.step(command) for command in commands]
    simulator.close()
    return states


@pytest.mark.parametrize("name", ROBOTS)
def test_positions_after_5_s_of_random_driving_are_those_of_the_full_engine(name):
    robot, generator = get_robot(name), torch.Generator().manual_seed(0)
    most = torch.tensor([min(robot.drive.max_speed, 1.0), min(robot.drive.max_yaw_rate, 2.0)])
    commands = (2 * torch.rand(10, 64, 2, generator=generator) - 1).mul(most).repeat_interleave(10, 0)
    planar, full = (driven(settings, robot, commands)[-1].position[:, :2] for settings in (PLANAR, WarpSettings()))
    error = (planar - full).norm(dim=-1)
    assert error.median() < 0.05
    assert error.quantile(0.95) < 0.1


@pytest.mark.parametrize("make", [vehicles.make_omni, vehicles.make_pair])
def test_rollers_and_casters_carry_a_robot_as_in_the_full_engine(make, tmp_path):
    robot, generator = make(tmp_path), torch.Generator().manual_seed(0)
    commands = (torch.rand(10, 32, 2 + robot.drive.sideways, generator=generator) - 0.5).repeat_interleave(10, 0)
    planar, full = (driven(settings, robot, commands)[-1] for settings in (PLANAR, WarpSettings()))
    assert (planar.position - full.position)[:, :2].norm(dim=-1).median() < 0.05
    for name in ("linear_velocity", "angular_velocity", *["lateral_velocity"] * robot.drive.sideways):
        torch.testing.assert_close(getattr(planar, name), getattr(full, name), rtol=0.05, atol=0.02)


@pytest.mark.filterwarnings("ignore:.*slope")
def test_weak_motors_speed_up_a_robot_and_its_wheels_as_in_the_full_engine(tmp_path):
    for robot in (get_robot("rover_zero"), vehicles.make_omni(tmp_path)):
        command = torch.zeros(12, 1, 2 + robot.drive.sideways).index_fill(2, torch.tensor(0), 1.0)
        weak = replace(robot, drive=replace(robot.drive, torque=robot.drive.torque / 12))
        planar, full = (driven(settings, weak, command) for settings in (PLANAR, WarpSettings()))
        way = [(states[-1].position - states[0].position)[0, 0].item() for states in (planar, full)]
        assert way[0] == pytest.approx(way[1], rel=0.05)
        odometry = [states[-1].linear_velocity[0, 0].item() for states in (planar, full)]
        assert 0.2 < odometry[1] < 0.8
        assert odometry[0] == pytest.approx(odometry[1], rel=0.05)


def test_a_spin_and_a_braking_distance_follow_the_law_of_friction():
    robot = get_robot("rover_zero")
    turned = driven(PLANAR, robot, torch.tensor([0.0, 1.0]).expand(60, 1, 2))
    yaw = [quaternion_to_euler(state.orientation)[0, 2].item() for state in turned]
    rate = math.remainder(yaw[-1] - yaw[-21], 2 * math.pi)
    assert rate == pytest.approx(coulomb.steady_motion(robot, robot.center_of_mass[0], 0.0, 1.0).yaw, rel=0.02)
    slippery = replace(PLANAR, ground_friction=0.3)
    commands = torch.cat((torch.tensor([1.0, 0.0]).expand(40, 1, 2), torch.zeros(30, 1, 2)))
    way = [state.position[0, 0].item() for state in driven(slippery, robot, commands)]
    assert way[39] - way[38] == pytest.approx(0.05, rel=1e-3)
    assert way[-1] - way[39] == pytest.approx(coulomb.braking_distance(0.3, 1.0), rel=0.05)
    assert way[-1] == way[-2]


def test_a_car_turns_in_the_radius_of_its_steering():
    robot = get_robot("hunter")
    states = driven(PLANAR, robot, torch.tensor([1.0, 0.4]).expand(100, 1, 2))
    yaw = [quaternion_to_euler(state.orientation)[0, 2].item() for state in states]
    assert math.remainder(yaw[-1] - yaw[-21], 2 * math.pi) == pytest.approx(0.4, rel=0.05)


def test_a_contact_is_told_within_a_step_of_the_full_engine():
    posts = [cylinder((2.5, y, 0.5), 0.15, 1.0) for y in (-2.0, 0.0, 2.0)]
    blocks = [box((2.5, y, 0.5), (0.6, 0.6, 1.0), yaw=0.4) for y in (-1.0, 1.0)]
    world = World("obstacles", Terrain.flat((40.0, 40.0)), [*posts, *blocks])
    generator = torch.Generator().manual_seed(0)
    poses = torch.rand(64, 3, generator=generator) * torch.tensor([0.3, 4.0, 0.6]) - torch.tensor([0.0, 2.0, 0.3])
    commands = torch.tensor([1.0, 0.0]).expand(60, 64, 2)
    found = []
    for settings in (PLANAR, WarpSettings()):
        states = driven(settings, get_robot("rover_zero"), commands, world, poses)
        touched = torch.stack([state.contact[:, 0] for state in states])
        found.append(torch.where(touched.any(0), touched.float().argmax(0), -9))
    assert (found[1] >= 0).sum() > 40
    assert ((found[0] - found[1]).abs() <= 1).float().mean() > 0.98


@pytest.mark.parametrize("name", ["maze:3", "rooms:1", "plaza"])
def test_the_lidar_reads_what_the_full_engine_reads(name):
    world, robot = get_world(name), get_robot("rover_zero")
    (x_low, x_high), (y_low, y_high) = world.spawn_range
    points = torch.rand(200, 3, generator=torch.Generator().manual_seed(0))
    poses = points * torch.tensor([x_high - x_low, y_high - y_low, 6.28]) + torch.tensor([x_low, y_low, 0.0])
    scans = []
    for settings in (PLANAR, WarpSettings()):
        simulator = placed(settings, world, poses, robot)
        scans.append(make_scanner(simulator, [world] * 200, robot, 128).scan().nan_to_num(posinf=99.0))
    # What stands in an obstacle reads 0 in the full engine.
    outside = scans[1].amin(1) > 0.05
    assert outside.sum() > 60
    assert ((scans[0] - scans[1])[outside].abs() < 0.01).float().mean() > 0.999


def test_movers_push_a_rover_as_in_the_full_engine():
    touched = []
    for physics in ("planar", "full"):
        env = make_env(backend="warp", physics=physics, world_n="field@1", num_envs=64, seed=0)
        td, count = env.reset(), 0
        for _ in range(60):
            _, td = env.step_and_maybe_reset(td.set("action", torch.zeros(64, 2)))
            count += env.base_env.rover_state.mover_contact.sum().item()
        touched.append(count)
        env.close()
    assert touched[1] > 20
    assert touched[0] == pytest.approx(touched[1], rel=0.2)


@pytest.mark.parametrize(
    ("world", "message"),
    [
        (get_world("moon"), "ground that is not level"),
        (World("ramp", Terrain.flat((9, 9)), [box((2, 0, 0.3), (1, 1, 1), pitch=0.3)]), "slanted faces"),
        (World("curb", Terrain.flat((9, 9)), [box((2, 0, 0.0), (1, 1, 0.1))]), "lower than 0.1[0-9] m"),
    ],
)
def test_what_is_not_level_is_refused(world, message):
    with pytest.raises(ValueError, match=message):
        make_env(backend="warp", physics="planar", world_n=world, num_envs=1)


def test_it_measures_no_forces():
    with pytest.raises(ValueError, match="contact"):
        make_env(backend="warp", physics="planar", world_n="maze", sensors=("contact",))
