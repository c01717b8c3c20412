"""Reward components that are not a part of the contract: clearance and action rate."""

from __future__ import annotations

import math

import pytest
import torch
from torchrl.envs.utils import check_env_specs

from rover_rl import RewardConfig, contract_reward, make_env
from rover_rl.envs.rewards import ActionRatePenalty, ClearancePenalty
from rover_rl.envs.transforms.action_repeat import ActionRepeat
from tests.envs.contract.scripted_env import pairs, play, scripted
from tests.envs.scripted import Moment


def component(results, name: str) -> list[list[float]]:
    """Values of a reward component, a list of rows for each step."""
    return [[round(value, 5) for value in td["reward_components", name].flatten().tolist()] for td in results]


def act(env, actions: list[tuple[float, float]], held: tuple[int, ...] = ()):
    """Takes one step with each action in every row. Rows that are ``held`` skip the second step."""
    td, results = env.reset(), []
    rows = td.batch_size[0]
    for number, action in enumerate(actions):
        td["action"] = pairs(action, rows)
        if held:
            td["_step"] = torch.tensor([[number != 1 or row not in held] for row in range(rows)])
        td = env.step(td)["next"]
        results.append(td)
    return results


def test_the_contracts_reward_has_neither_by_default():
    names = [part.name for part in contract_reward()]
    assert not {"clearance", "action_rate"} & set(names)
    both = contract_reward(RewardConfig(clearance_penalty=-0.1, action_rate_penalty=-0.01))
    assert [part.name for part in both] == [*names, "clearance", "action_rate"]


def test_the_clearance_penalty_grows_linearly_below_its_distance():
    scripts = [[Moment(ranges=reading)] for reading in (0.0, 0.1, 0.35, 0.4, 5.0)]
    reward = RewardConfig(clearance_penalty=-0.2, clearance_distance=0.4)
    (result,) = play(scripted(*scripts, reward=reward), 1)
    assert component([result], "clearance") == [[-0.2, -0.15, -0.025, 0.0, 0.0]]
    # On top of the contract's rule for the step, here a collision.
    assert result["reward"][1].item() == pytest.approx(-0.5 - 0.15)


def test_only_the_nearest_reading_counts_for_the_clearance():
    readings = [5.0] * 32
    readings[20] = 0.2
    results = play(scripted([Moment(ranges=readings)], reward=[ClearancePenalty(-1.0, 0.8)]), 1)
    assert component(results, "clearance") == [[-0.75]]


def test_a_clearance_distance_of_0_is_refused():
    with pytest.raises(ValueError, match="clearance_distance must be positive, got 0"):
        RewardConfig(clearance_distance=0)


def test_the_action_rate_penalty_is_the_squared_change_of_the_action():
    env = scripted([Moment()], reward=RewardConfig(action_rate_penalty=-0.1))
    results = act(env, [(1.0, 0.5), (0.5, 0.5), (0.5, -0.5), (0.5, -0.5)])
    assert component(results, "action_rate") == [[0.0], [-0.025], [-0.1], [0.0]]


def test_opposite_bounds_of_the_heading_are_the_same_direction():
    env = scripted([Moment()], reward=[ActionRatePenalty(-1.0)])
    results = act(env, [(0.0, math.pi - 0.1), (0.0, -math.pi + 0.1)])
    assert component(results, "action_rate")[1] == [pytest.approx(-0.04, abs=1e-4)]


def test_the_first_action_of_each_episode_is_free():
    env = scripted([Moment()], [Moment()], reward=[ActionRatePenalty(-1.0)])
    td = act(env, [(1.0, 0.0)])[-1]
    td["_reset"] = torch.tensor([[True], [False]])
    td = env.reset(td)
    td["action"] = pairs((-1.0, 0.0), 2)
    assert component([env.step(td)["next"]], "action_rate") == [[0.0, -4.0]]


def test_a_held_row_keeps_its_last_action():
    env = scripted([Moment()], [Moment()], reward=[ActionRatePenalty(-1.0)])
    results = act(env, [(0.0, 0.0), (1.0, 0.0), (1.0, 0.0)], held=(1,))
    assert component(results, "action_rate")[0] == [0.0, 0.0]
    assert component(results, "action_rate")[2] == [0.0, -1.0]


def test_a_repeated_action_changes_once():
    env = scripted([Moment()], reward=[ActionRatePenalty(-1.0)]).append_transform(ActionRepeat(4))
    results = act(env, [(0.1, 0.0), (0.6, 0.0), (0.6, 0.0), (0.1, 0.0)])
    assert component(results, "action_rate") == [[0.0], [-0.25], [0.0], [-0.25]]


@pytest.mark.parametrize("num_envs", [None, 3])
def test_specs_hold_with_both(num_envs):
    reward = RewardConfig(clearance_penalty=-0.1, action_rate_penalty=-0.01)
    env = make_env(world_n="maze", num_envs=num_envs, backend="warp", reward=reward, lidar_beams=32)
    check_env_specs(env)
    rollout = env.rollout(4)
    parts = rollout["next", "reward_components"]
    assert parts["action_rate"][..., 1:, :].max() < 0
    torch.testing.assert_close(rollout["next", "reward"], sum(parts.values()))
