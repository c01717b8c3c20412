"""``GridPlanner``, driven by a ``PolicyRunner``."""

from __future__ import annotations

import math
from itertools import pairwise

import pytest
import torch
from torch import Tensor

from rover_rl import RoverEnv
from rover_rl.algos.policy.grid_planner import GridPlanner, follow
from rover_rl.algos.policy.runner import PolicyRunner
from rover_rl.envs.config import TaskConfig
from rover_rl.sims.robots import get_robot

ROBOT = get_robot("rover_zero")
OPEN = torch.full((64,), 12.0)
LEVEL = torch.zeros(3)


def route(angle: float) -> Tensor:
    """A route of 3 m whose first corner is in a direction."""
    return torch.tensor([3.0, angle, 3.0, angle, 3.0])


def wall(distance: float, direction: float) -> Tensor:
    """Readings of a wall at a distance from the lidar, perpendicular to a direction."""
    beams = (torch.arange(64) + 0.5) * (2 * math.pi / 64) - direction
    return torch.where(beams.cos() > 0.05, distance / beams.cos(), 12.0).clamp(max=12.0)


def test_on_free_ground_it_drives_along_the_route_at_full_speed() -> None:
    speed, turn = follow(OPEN, LEVEL, route(0.0), ROBOT).tolist()
    assert (speed, turn) == (1.0, 0.0)
    speed, turn = follow(OPEN, LEVEL, route(0.5), ROBOT).tolist()
    assert 0.5 < speed < 1.0
    assert turn == pytest.approx(1.0)


def test_it_turns_on_the_spot_if_the_route_leads_back() -> None:
    assert follow(OPEN, LEVEL, route(2.5), ROBOT)[0] == 0.0


def test_on_a_slope_it_turns_in_a_slow_curve() -> None:
    """While it turns on the spot, it slides."""
    for tilt in (torch.tensor([-0.2, 0.0, 0.0]), torch.tensor([0.0, 0.2, 0.0])):
        speed, turn = follow(OPEN, tilt, route(2.5), ROBOT).tolist()
        assert 0.1 < speed < 0.3
        assert turn == pytest.approx(math.pi)
        assert follow(wall(0.1, 0.0), tilt, route(2.5), ROBOT)[0] < 0.0
    assert follow(OPEN, LEVEL, route(2.5), ROBOT)[0] == 0.0


def test_in_front_of_a_wall_it_slows_down_and_backs_off() -> None:
    speeds = [float(follow(wall(distance, 0.0), LEVEL, route(0.0), ROBOT)[0]) for distance in (3.0, 0.5, 0.3, 0.1)]
    assert speeds == sorted(speeds, reverse=True)
    assert speeds[0] == 1.0
    assert speeds[-1] < 0.0


def test_it_does_not_back_into_a_wall_behind() -> None:
    between = torch.minimum(wall(0.1, 0.0), wall(0.5, math.pi))
    assert follow(between, LEVEL, route(0.0), ROBOT)[0] == 0.0


def test_it_backs_down_a_slope_that_is_too_steep() -> None:
    uphill = torch.tensor([-0.5, 0.0, 0.0])
    speed, turn = follow(OPEN, uphill, route(0.5), ROBOT).tolist()
    assert speed < 0.0
    assert turn == 0.0
    downhill = torch.tensor([0.5, 0.0, 0.0])
    assert follow(OPEN, downhill, route(0.5), ROBOT)[0] > 0.0


def test_it_reaches_goals_in_mazes_without_a_contact() -> None:
    task = TaskConfig(collision_from="contact", collision_window=0)
    env = RoverEnv(world_n="maze:9000-9015", num_envs=16, seed=0, backend="warp", end_on_goal=True, task=task)
    runner, observation = PolicyRunner(GridPlanner(), env=env), env.reset()
    ended, reached = (torch.zeros(16, dtype=torch.bool) for _ in range(2))
    with torch.no_grad():
        for _ in range(800):
            observation = env.step(observation.set("action", runner(observation)).set("_step", ~ended))["next"]
            reached |= ~ended & observation["outcome", "goal_reached"].squeeze(-1)
            ended |= observation["done"].squeeze(-1)
            if ended.all():
                break
    assert reached.sum() >= 15


def test_it_plans_at_the_times_at_which_a_decision_is_due() -> None:
    env = RoverEnv(world_n="maze", num_envs=16, seed=0, backend="warp")
    runner, observation = PolicyRunner(GridPlanner(), env=env), env.reset()
    assert runner.action_repeat == 4
    actions = []
    for _ in range(9):
        action = runner(observation)
        actions.append(action)
        observation = env.step(observation.set("action", action))["next"]
    changed = {step for step, (last, action) in enumerate(pairwise(actions), 1) if (last != action).any()}
    assert changed
    assert changed <= {4, 8}


def test_a_new_episode_clears_its_rows_map_only() -> None:
    env = RoverEnv(world_n="maze", num_envs=2, seed=0, backend="warp")
    runner, observation = PolicyRunner(GridPlanner(), env=env), env.reset()
    before = runner(observation)
    # The first row faces a closed room around it, which it then forgets.
    blind = observation.clone()
    blind["lidar"][0] = 0.6
    every = torch.ones(2, dtype=torch.bool)
    runner(blind, due=every)
    runner.reset(torch.tensor([True, False]))
    after = runner(observation, due=every)
    assert torch.equal(after, before)
