"""Planners ask the drive of their robot whether it turns in place, and how sharply it turns."""

from __future__ import annotations

import math

import pytest
import torch
from tensordict import TensorDict

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

BEHIND = math.radians(150)
OPEN = World("open", Terrain.flat((20, 20)))


def first_action(policy, robot):
    """Returns the speed and the heading offset for a goal that lies behind, in the open."""
    points = policy.made_for.lidar.points if hasattr(policy, "made_for") else 32
    config = EnvConfig(world=OPEN, robot=robot, lidar=LidarConfig(points=points, beams=128), seed=0, backend="warp")
    env = RoverEnv(sensors_for(policy, config))
    goal = 5 * torch.tensor([[math.cos(BEHIND), math.sin(BEHIND)]])
    observation = env.reset(start=torch.zeros(1, 3), goal=goal)
    return PolicyRunner(policy, env=env)(observation)[0].tolist()


@pytest.mark.parametrize("kind", [ScriptedPolicy, GridPlanner, MapExpert])
def test_a_car_drives_while_it_turns_and_a_rover_turns_in_place(kind, tmp_path):
    rover = get_robot("rover_zero")
    speed, offset = first_action(kind(rover), rover)
    assert speed <= 0
    assert offset > 1
    car = make_car(tmp_path)
    speed, offset = first_action(kind(car), car)
    # It turns around on its way, or backs towards the goal, whichever is shorter, and not sharper than it can.
    assert abs(speed) > 0.1
    assert abs(offset * HeadingGains.kp) * car.drive.min_radius(car.wheels) <= abs(speed) + 1e-4


def test_the_dynamic_window_of_a_car_has_no_turn_sharper_than_it_takes(tmp_path):
    car = make_car(tmp_path)
    policy = DynamicWindowPolicy(car, yaw_gain=1.0)
    for bearing in torch.linspace(-3, 3, 13).tolist():
        lidar = torch.full((1, policy.made_for.lidar.points), 12.0)
        inputs = {"lidar": lidar, "target": torch.tensor([[3.0, bearing]]), "velocities": torch.tensor([[0.5, 0.0]])}
        speed, offset = policy(TensorDict(inputs, [1]))["action"][0].tolist()
        assert abs(offset * HeadingGains.kp) * car.drive.min_radius(car.wheels) <= abs(speed) + 1e-4
