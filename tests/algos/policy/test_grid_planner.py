"""``GridPlanner``, driven by a ``PolicyRunner``."""

from __future__ import annotations

import math
from itertools import pairwise

import pytest
import torch
from torch import Tensor

from rover_rl import RoverEnv
from rover_rl.algos.policy.arcs import hit_points
from rover_rl.algos.policy.grid_planner import Follower, GridPlanner, follow, way_point
from rover_rl.algos.policy.runner import PolicyRunner, sensors_for
from rover_rl.envs.config import EnvConfig
from rover_rl.robots import get_robot
from tests.algos.policy.crossings import reached

ROBOT = get_robot("rover_zero")
OPEN = torch.full((64,), 12.0)
LEVEL = torch.zeros(3)


def act(lidar: Tensor, imu: Tensor = LEVEL, angle: float = 0.0, scan_pose: Tensor | None = None) -> list[float]:
    """Speed and heading offset on a route of 3 m whose first corner is in a direction."""
    return follow(lidar, imu, torch.tensor([3.0, angle, 3.0, angle, 3.0]), Follower.of(ROBOT), scan_pose).tolist()


def wall(distance: float, direction: float) -> Tensor:
    """Readings of a wall at a distance from the lidar, perpendicular to a direction."""
    beams = (torch.arange(64) + 0.5) * (2 * math.pi / 64) - direction
    return torch.where(beams.cos() > 0.05, distance / beams.cos(), 12.0).clamp(max=12.0)


UPHILL, ASIDE, STEEP = (torch.tensor(tilt) for tilt in ((-0.2, 0.0, 0.0), (0.0, 0.2, 0.0), (-0.5, 0.0, 0.0)))


@pytest.mark.parametrize(
    ("lidar", "imu", "angle", "speeds", "turn"),
    [
        (OPEN, LEVEL, 0.0, (1.0, 1.0), 0.0),
        (OPEN, LEVEL, 0.5, (0.5, 1.0), 1.0),
        (OPEN, LEVEL, 2.5, (0.0, 0.0), math.pi),  # It turns on the spot if the route leads back.
        # On a slope, it would slide while it turns on the spot.
        (OPEN, UPHILL, 2.5, (0.1, 0.3), math.pi),
        (OPEN, ASIDE, 2.5, (0.1, 0.3), math.pi),
        (wall(0.1, 0.0), UPHILL, 2.5, (-1.0, -0.1), math.pi),
        # It backs off in front of a wall, but not into one behind, and down a slope that is too steep.
        (wall(0.1, 0.0), LEVEL, 0.0, (-1.0, -0.1), 0.0),
        (torch.minimum(wall(0.1, 0.0), wall(0.5, math.pi)), LEVEL, 0.0, (0.0, 0.0), 0.0),
        (OPEN, STEEP, 0.5, (-1.0, -0.1), 0.0),
        (OPEN, -STEEP, 0.5, (0.1, 1.0), 1.0),
    ],
)
def test_it_follows_its_route_as_the_ground_permits(lidar, imu, angle, speeds, turn) -> None:
    speed, offset = act(lidar, imu, angle)
    assert speeds[0] <= speed <= speeds[1]
    assert offset == pytest.approx(turn)


def test_in_front_of_a_wall_it_slows_down() -> None:
    speeds = [act(wall(distance, 0.0))[0] for distance in (3.0, 0.5, 0.3, 0.1)]
    assert speeds == sorted(speeds, reverse=True)


def test_a_late_scan_counts_where_it_was_taken() -> None:
    """Since the scan of a wall 0.9 m straight ahead, the rover has driven 0.6 m and turned by 0.5 rad."""
    lidar, mount, turned = wall(0.9, 0.0), ROBOT.lidar_position[0], torch.tensor(0.5)
    scan_pose = torch.tensor([-0.6 * turned.cos(), 0.6 * turned.sin(), 0.0, 0.0, 0.0, -turned])
    x, y = hit_points(lidar, mount, scan_pose=scan_pose)
    away = (x * turned.cos() - y * turned.sin())[lidar < 12]
    torch.testing.assert_close(away, torch.full_like(away, mount + 0.9 - 0.6))
    assert act(lidar, scan_pose=scan_pose)[0] < 0.5 < act(lidar)[0]


@pytest.mark.parametrize("make", [lambda: ROBOT, pytest.param(lambda: get_robot("racer"), marks=pytest.mark.slow)])
def test_it_reaches_goals_in_mazes_without_a_contact(make) -> None:
    robot = make()
    assert reached(GridPlanner(robot), "maze:9000-9005", 6, 40.0, robot) >= 5


def test_it_plans_at_the_times_at_which_a_decision_is_due() -> None:
    env = RoverEnv(sensors_for(GridPlanner(), EnvConfig(world="maze", num_envs=16, seed=0, backend="warp")))
    runner, observation, actions = PolicyRunner(GridPlanner(), env=env), env.reset(), []
    for _ in range(9):
        actions.append(runner(observation))
        observation = env.step(observation.set("action", actions[-1]))["next"]
    changed = {step for step, (last, action) in enumerate(pairwise(actions), 1) if (last != action).any()}
    assert changed
    assert changed <= {4, 8}


def test_the_place_on_a_route_is_that_far_along_it():
    route = torch.tensor([[2.0, 0.0, math.hypot(2, 1), math.atan2(1, 2), 3.0]])
    for ahead, place in {1.5: (1.5, 0.0), 2.5: (2.0, 0.5), 9.0: (2.0, 1.0)}.items():
        assert torch.allclose(way_point(route, ahead), torch.tensor([place]), atol=1e-5)
