"""Random actions and the scripted driver."""

from __future__ import annotations

import math
import pickle
from dataclasses import replace

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor

from rover_rl.algos.policy.baselines import RandomPolicy, ScriptedPolicy
from rover_rl.robots.built_in import ROVER_ZERO
from tests.algos.policy.crossings import reached

CLEAR = torch.full((1, 32), 12.0)


def wall_ahead(distance: float) -> Tensor:
    """Readings of a long wall across the path, ``distance`` m in front of the lidar."""
    angle = (torch.arange(32) + 0.5) * (2 * math.pi / 32)
    return torch.where(angle.cos() > 0.05, distance / angle.cos().clamp(min=0.05), 12.0).clamp(max=12.0)[None]


def steer(lidar: Tensor, distance: float, degrees: float, robot="rover_zero") -> list[float]:
    target = torch.tensor([[distance, math.radians(degrees)]])
    policy = pickle.loads(pickle.dumps(ScriptedPolicy(robot)))
    return policy(TensorDict({"lidar": lidar, "target": target}, [1]))["action"][0].tolist()


def actions(episode: list[int], steps: list[int], seed: int = 0) -> Tensor:
    td = TensorDict({"outcome": {"steps": torch.tensor(steps)[:, None]}}, [len(episode)])
    return RandomPolicy(seed)(td.set("episode", torch.tensor(episode)[:, None]))["action"]


def test_random_actions_are_uniform_over_the_bounds_and_do_not_depend_on_other_rows() -> None:
    together = actions([0, 1, 2, 5], [7, 7, 3, 0])
    for row, (episode, step) in enumerate([(0, 7), (1, 7), (2, 3), (5, 0)]):
        assert torch.equal(actions([episode], [step])[0], together[row])
    assert not torch.equal(actions([0], [7], seed=1), actions([0], [7]))
    drawn = actions([*range(100)] * 100, [step for step in range(100) for _ in range(100)])
    limits = torch.tensor([1.0, math.pi])
    assert (drawn.abs() <= limits).all()
    torch.testing.assert_close(drawn.mean(0) / limits, torch.zeros(2), rtol=0, atol=0.02)
    torch.testing.assert_close(drawn.std(0) / limits, torch.full((2,), 3**-0.5), rtol=0.02, atol=0)


@pytest.mark.parametrize("degrees", [-150, -20, 0, 25, 90])
def test_it_drives_towards_a_goal_and_around_a_wall_on_its_side(degrees: float) -> None:
    speed, heading = steer(CLEAR, 5.0, degrees)
    assert (speed, heading) == pytest.approx((1.0, 0.0)) if degrees == 0 else speed < 1
    assert heading * degrees >= 0
    if 0 < abs(degrees) < 30:
        speed, heading = steer(wall_ahead(0.6), 5.0, degrees)
        assert heading * degrees > 0
        assert abs(heading) > math.radians(40)
        assert speed < 0.5


def test_it_backs_off_from_a_close_obstacle_unless_one_is_behind_and_drives_to_a_goal_before_a_wall() -> None:
    between = wall_ahead(0.32)
    between[:, 14:18] = 0.6
    assert steer(wall_ahead(0.32), 5.0, 0.0)[0] < 0 <= steer(between, 5.0, 0.0)[0]
    speed, heading = steer(wall_ahead(1.2), 0.9, 0.0)
    assert speed > 0.3
    assert abs(heading) < 0.1


def test_the_place_of_the_lidar_is_that_of_the_robot() -> None:
    x, y, z = ROVER_ZERO.lidar_position
    # The same readings are closer to the center of a rover whose lidar is farther back.
    rear = replace(ROVER_ZERO, lidar_position=(x - 0.2, y, z))
    assert steer(wall_ahead(0.9), 0.5, 0.0, rear)[0] < steer(wall_ahead(0.9), 0.5, 0.0)[0]
    with pytest.raises(ValueError, match="unknown robot 'tank'"):
        ScriptedPolicy("tank")


def test_actions_are_always_within_their_bounds() -> None:
    generator = torch.Generator().manual_seed(0)
    lidar = 12 * torch.rand(500, 32, generator=generator) ** 3
    target = torch.rand(500, 2, generator=generator) * torch.tensor([20.0, 6.2]) - torch.tensor([0.0, 3.1])
    lidar[0], target[1] = 0.0, 0.0
    action = ScriptedPolicy()(TensorDict({"lidar": lidar, "target": target}, [500]))["action"]
    assert action.isfinite().all()
    assert (action.abs() <= torch.tensor([1.0, math.pi + 1e-6])).all()


@pytest.mark.slow
def test_it_finds_most_goals_in_the_maze_without_a_collision() -> None:
    assert reached(ScriptedPolicy(), "maze:0-2", 3, 20.0) >= 2
