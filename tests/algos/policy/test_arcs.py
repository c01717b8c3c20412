"""Arcs of robots that do not turn in place, and how planners use them."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st
from tensordict import TensorDict

from rover_rl.algos.policy.arcs import SAFETY, Body, all_arcs, drive_among, free_lengths
from rover_rl.algos.policy.baselines import ScriptedPolicy
from rover_rl.algos.policy.dwa import DynamicWindowPolicy
from rover_rl.algos.policy.expert import MapExpert
from rover_rl.algos.policy.grid_planner import GridPlanner
from rover_rl.algos.policy.runner import PolicyRunner, sensors_for
from rover_rl.envs.config import EnvConfig, HeadingGains, LidarConfig
from rover_rl.envs.rover import RoverEnv
from rover_rl.robots import get_robot
from rover_rl.worlds import Terrain, World
from tests.robots.drives.vehicles import make_car

STEP = 0.01  # m
SIZES = {"behind": 0.2, "ahead": 0.6, "half_width": 0.3, "radius": 0.9, "pivot": -0.3, "max_speed": 1.5, "reverse": 1.4}


def bodies(count: int = 1, **sizes: float) -> Body:
    return Body(**{name: torch.full((count, 1), value) for name, value in (SIZES | sizes).items()})


def driven_until_contact(x: float, y: float, body: Body, gear: float, curvature: float, longest: float) -> float:
    """Length of an arc up to a pose in which a point is in the rectangle, by trying poses."""
    way = gear * torch.arange(0.0, longest, STEP)
    heading = way * curvature
    chord = way * torch.sinc(heading / (2 * math.pi))
    dx, dy = x - chord * (heading / 2).cos(), y - chord * (heading / 2).sin()
    ahead, aside = dx * heading.cos() + dy * heading.sin(), dy * heading.cos() - dx * heading.sin()
    inside = (-body.behind[0] < ahead) & (ahead < body.ahead[0]) & (aside.abs() < body.half_width[0])
    return way.abs()[inside].min().item() if inside.any() else math.inf


@settings(max_examples=30)
@given(
    place=st.tuples(st.floats(-3, 3), st.floats(-3, 3)),
    size=st.tuples(st.floats(0.1, 0.4), st.floats(0.3, 0.8), st.floats(0.15, 0.4), st.floats(0.5, 1.5)),
)
@example(place=(0.859375, 0.0), size=(0.21875, 0.5, 0.20963109478706965, 0.7734375))
def test_free_lengths_are_those_up_to_the_first_pose_in_contact(place, size):
    names, grown = ("behind", "ahead", "half_width", "radius"), STEP / 2
    body = bodies(**dict(zip(names, size, strict=True)))
    larger = bodies(**dict(zip(names, (*(side + grown for side in size[:3]), size[3]), strict=True)))
    x, y = place
    if -size[0] - STEP < x < size[1] + STEP and abs(y) < size[2] + STEP:
        return  # in the body
    free = free_lengths(torch.tensor([[x]]), torch.tensor([[y]]), body, 0.0)[0]
    for gear, bend, length in zip(*(each.tolist() for each in (*all_arcs(free.device), free)), strict=True):
        turn = 2 * math.pi * size[3] / abs(bend) if bend else 4.0
        tried = driven_until_contact(x, y, body, gear, bend / size[3], turn)
        if tried < turn - 3 * STEP:
            assert length <= tried + STEP
            # A corner of the body may touch a point within less than a step, so that no pose that is tried does.
            near = driven_until_contact(x, y, larger, gear, bend / size[3], turn)
            assert length >= min(tried, near) - 0.1


def act(place: tuple[float, float], points: list[tuple[float, float]], speed: float = 0.0, **sizes: float):
    x, y = torch.tensor(points or [(50.0, 0.0)]).T[:, None]
    velocities = torch.tensor([[speed, 0.0]])
    return drive_among(torch.tensor([place]), torch.tensor([[2.0]]), x, y, velocities, bodies(**sizes))[0].tolist()


def test_it_drives_straight_to_a_place_ahead_in_a_curve_to_one_beside_and_backs_off_from_a_wall():
    assert act((3.0, 0.0), []) == [1.5, 0.0]
    speed, offset = act((1.5, 1.2), [])
    assert speed > 0.5
    assert offset > 0.1
    assert act((-0.5, 1.5), [(0.45, y / 10) for y in range(-15, 16)])[0] < 0
    # The mirror image of what it sees mirrors what it does.
    assert act((1.5, -1.2), []) == pytest.approx([speed, -offset])
    # A slow robot drives at its speed, and one that drives goes on in its direction.
    assert act((3.0, 0.0), [], max_speed=0.3)[0] == pytest.approx(0.3)
    forward, backward = (act((-0.3, 1.2), [], speed)[0] for speed in (0.6, -0.4))
    assert forward > 0 or backward < 0


def test_rows_do_not_depend_on_their_company_and_no_turn_is_sharper_than_the_robot_can_drive():
    generator = torch.Generator().manual_seed(1)
    # An odd number of points, as kernels of PyTorch round otherwise at the end of a tensor.
    x, y = 3 * torch.randn(2, 9, 33, generator=generator)
    place, velocities = torch.randn(2, 9, 2, generator=generator)
    rows = (place, place[:, :1].abs(), x, y, velocities)
    together, lengths = drive_among(*rows, bodies(9)), free_lengths(x, y, bodies(9), SAFETY)
    for row in range(9):
        assert drive_among(*(value[row : row + 1] for value in rows), bodies()).equal(together[row : row + 1])
        assert free_lengths(x[row : row + 1], y[row : row + 1], bodies(), SAFETY).equal(lengths[row : row + 1])
    speed, offset = together.unbind(-1)
    assert (HeadingGains.kp * offset.abs() <= speed.abs() / SIZES["radius"] + 1e-5).all()


@pytest.mark.parametrize("kind", [ScriptedPolicy, GridPlanner, MapExpert])
def test_a_car_drives_while_it_turns_and_a_rover_turns_in_place(kind, tmp_path):
    car = make_car(tmp_path)
    behind = 5 * torch.tensor([[math.cos(2.6), math.sin(2.6)]])
    actions = []
    for robot in (get_robot("rover_zero"), car):
        policy = kind(robot)
        lidar = LidarConfig(points=policy.made_for.lidar.points if hasattr(policy, "made_for") else 32)
        world = World("open", Terrain.flat((20, 20)))
        env = RoverEnv(sensors_for(policy, EnvConfig(world=world, robot=robot, lidar=lidar, seed=0, backend="warp")))
        observation = env.reset(start=torch.zeros(1, 3), goal=behind)
        actions.append(PolicyRunner(policy, env=env)(observation)[0].tolist())
    assert actions[0][0] <= 0
    assert actions[0][1] > 1
    # It turns around on its way, or backs towards the goal, whichever is shorter, and not sharper than it can.
    speed, offset = actions[1]
    assert abs(speed) > 0.1
    assert abs(offset * HeadingGains.kp) * car.drive.min_radius(car.wheels) <= abs(speed) + 1e-4


def test_the_dynamic_window_of_a_car_has_no_turn_sharper_than_it_takes(tmp_path):
    car = make_car(tmp_path)
    policy, bearing = DynamicWindowPolicy(car, yaw_gain=1.0), torch.linspace(-3, 3, 13)[:, None]
    lidar, ones = torch.full((13, policy.made_for.lidar.points), 12.0), torch.ones(13, 1)
    inputs = {
        "lidar": lidar,
        "target": torch.cat((3 * ones, bearing), -1),
        "velocities": torch.cat((ones / 2, 0 * ones), -1),
    }
    speed, offset = policy(TensorDict(inputs, [13]))["action"].unbind(-1)
    assert ((offset * HeadingGains.kp).abs() * car.drive.min_radius(car.wheels) <= speed.abs() + 1e-4).all()
