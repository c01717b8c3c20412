from __future__ import annotations

import math
import pickle
from dataclasses import replace

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from tensordict import TensorDict
from torch import Tensor

from rover_rl.algos.evaluation.episodes import draw_episodes
from rover_rl.algos.evaluation.evaluate import evaluate
from rover_rl.algos.policy.baselines import RandomPolicy, ScriptedPolicy, drive_towards, steer
from rover_rl.envs.config import EnvConfig
from rover_rl.robots.built_in import ROVER_ZERO

CLEAR = torch.full((1, 32), 12.0)


def target(distance: float, degrees: float) -> Tensor:
    return torch.tensor([[distance, math.radians(degrees)]])


def wall_ahead(distance: float) -> Tensor:
    """Readings of a long wall across the path, ``distance`` m in front of the lidar."""
    angle = (torch.arange(32) + 0.5) * (2 * math.pi / 32)
    return torch.where(angle.cos() > 0.05, distance / angle.cos().clamp(min=0.05), 12.0).clamp(max=12.0)[None]


# --- random


def actions(episode: list[int], steps: list[int], seed: int = 0) -> Tensor:
    count = len(episode)
    td = TensorDict({"outcome": {"steps": torch.tensor(steps)[:, None]}}, [count])
    return RandomPolicy(seed)(td.set("episode", torch.tensor(episode)[:, None]))["action"]


def test_random_actions_do_not_depend_on_other_rows() -> None:
    together = actions([0, 1, 2, 5], [7, 7, 3, 0])
    for row, (episode, step) in enumerate([(0, 7), (1, 7), (2, 3), (5, 0)]):
        assert torch.equal(actions([episode], [step])[0], together[row])
    assert len(together.unique(dim=0)) == 4
    assert not torch.equal(actions([0], [7], seed=1), actions([0], [7]))


def test_random_actions_are_uniform_over_the_bounds() -> None:
    drawn = actions([*range(100)] * 100, [step for step in range(100) for _ in range(100)])
    limits = torch.tensor([1.0, math.pi])
    assert (drawn.abs() <= limits).all()
    torch.testing.assert_close(drawn.mean(0) / limits, torch.zeros(2), rtol=0, atol=0.02)
    torch.testing.assert_close(drawn.std(0) / limits, torch.full((2,), 3**-0.5), rtol=0.02, atol=0)


# --- scripted


@pytest.mark.parametrize("degrees", [-150, -40, 0, 25, 90])
def test_it_drives_towards_a_goal_on_open_ground(degrees: float) -> None:
    speed, heading = steer(CLEAR, target(5.0, degrees))[0].tolist()
    assert (speed, heading) == pytest.approx((1.0, 0.0)) if degrees == 0 else speed < 1
    assert heading * degrees >= 0


@pytest.mark.parametrize("degrees", [-20, 20])
def test_it_goes_around_a_wall_on_the_side_of_the_goal(degrees: float) -> None:
    speed, heading = steer(wall_ahead(0.6), target(5.0, degrees))[0]
    assert heading * degrees > 0
    assert abs(heading) > math.radians(40)
    assert speed < 0.5


def test_it_backs_off_from_a_close_obstacle_unless_one_is_behind_and_drives_to_a_goal_before_a_wall() -> None:
    between = wall_ahead(0.32)
    between[:, 14:18] = 0.6
    assert steer(wall_ahead(0.32), target(5.0, 0.0))[0, 0] < 0 <= steer(between, target(5.0, 0.0))[0, 0]
    speed, heading = steer(wall_ahead(1.2), target(0.9, 0.0))[0]
    assert speed > 0.3
    assert abs(heading) < 0.1


def test_the_lidar_offset_is_that_of_the_robot() -> None:
    lidar, goal = wall_ahead(0.9), target(5.0, 0.0)
    x, y, z = ROVER_ZERO.lidar_position
    rear = replace(ROVER_ZERO, lidar_position=(x - 0.2, y, z))
    for policy, offset in ((ScriptedPolicy(), x), (ScriptedPolicy("rover_zero"), x), (ScriptedPolicy(rear), x - 0.2)):
        action = pickle.loads(pickle.dumps(policy))(TensorDict({"lidar": lidar, "target": goal}, [1]))["action"]
        assert torch.equal(action, steer(lidar, goal, offset))
    assert torch.equal(steer(lidar, goal), steer(lidar, goal, x))
    # The same readings are closer to the center of a rover whose lidar is farther back.
    assert drive_towards(goal[:, 1:], lidar, x - 0.2)[0, 0] < drive_towards(goal[:, 1:], lidar)[0, 0]
    with pytest.raises(ValueError, match="unknown robot 'tank'"):
        ScriptedPolicy("tank")


READING = st.floats(0.0, 12.0, width=32)


@given(
    st.lists(READING, min_size=32, max_size=32),
    st.floats(0.0, 100.0, width=32),
    st.floats(-3.140625, 3.140625, width=32),
)
def test_actions_are_always_within_their_bounds(lidar: list[float], distance: float, angle: float) -> None:
    action = steer(torch.tensor([lidar]), torch.tensor([[distance, angle]]))
    assert action.isfinite().all()
    assert (action.abs() <= torch.tensor([1.0, math.pi + 1e-6])).all()


@pytest.mark.slow
def test_it_finds_most_goals_in_the_maze_without_a_collision() -> None:
    driven = evaluate(ScriptedPolicy(), draw_episodes("maze", 6, seed=1), env=EnvConfig(backend="warp"), seconds=20)
    assert driven.success_rate >= 5 / 6
    assert driven.metrics["collisions"].value == 0
