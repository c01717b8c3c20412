"""Reward components that are not a part of the contract: clearance, action rate, and those of movers."""

from __future__ import annotations

import math

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import check_env_specs

from rover_rl import RewardConfig, contract_reward, make_env
from rover_rl.envs import rewards
from rover_rl.envs.task import StepEvent
from rover_rl.envs.transforms.action_repeat import ActionRepeat
from tests.envs.scripted import Moment, pairs, play, scripted

RATE = RewardConfig(action_rate_penalty=-1.0)


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


def test_components_with_penalties_of_0_are_left_out():
    names = [part.name for part in contract_reward()]
    assert not {"clearance", "action_rate", "mover_contact", "mover_proximity"} & set(names)
    config = RewardConfig(clearance_penalty=-0.1, action_rate_penalty=-0.01, struck_penalty=-1, haste_penalty=-1)
    every = [part.name for part in contract_reward(config)]
    assert every == [*names, "clearance", "action_rate", "mover_contact", "mover_proximity"]


def test_the_clearance_penalty_grows_linearly_below_its_distance_with_the_nearest_reading():
    nearest = [5.0] * 20 + [0.2] + [5.0] * 11
    scripts = [[Moment(ranges=reading)] for reading in (0.0, 0.1, 0.35, 0.4, 5.0, nearest)]
    reward = RewardConfig(clearance_penalty=-0.2, clearance_distance=0.4)
    (result,) = play(scripted(*scripts, reward=reward), 1)
    assert component([result], "clearance") == [[-0.2, -0.15, -0.025, 0.0, 0.0, -0.1]]
    # On top of the contract's rule for the step, here a collision.
    assert result["reward"][1].item() == pytest.approx(-0.5 - 0.15)
    with pytest.raises(ValueError, match="clearance_distance must be positive"):
        RewardConfig(clearance_distance=0)


def test_the_action_rate_penalty_is_the_squared_change_of_the_action():
    results = act(scripted([Moment()], reward=RATE), [(1.0, 0.5), (0.5, 0.5), (0.5, -0.5), (0.5, -0.5)])
    assert component(results, "action_rate") == [[0.0], [-0.25], [-1.0], [0.0]]
    # Opposite bounds of the heading are the same direction.
    results = act(scripted([Moment()], reward=RATE), [(0.0, math.pi - 0.1), (0.0, -math.pi + 0.1)])
    assert component(results, "action_rate")[1] == [pytest.approx(-0.04, abs=1e-4)]
    # A held row keeps its last action.
    results = act(scripted([Moment()], [Moment()], reward=RATE), [(0.0, 0.0), (1.0, 0.0), (1.0, 0.0)], held=(1,))
    assert component(results, "action_rate")[2] == [0.0, -1.0]
    # A repeated action changes once.
    env = scripted([Moment()], reward=RATE).append_transform(ActionRepeat(4))
    results = act(env, [(0.1, 0.0), (0.6, 0.0), (0.6, 0.0), (0.1, 0.0)])
    assert component(results, "action_rate") == [[0.0], [-0.25], [0.0], [-0.25]]


def test_the_first_action_of_each_episode_is_free():
    env = scripted([Moment()], [Moment()], reward=RATE)
    td = act(env, [(1.0, 0.0)])[-1]
    td = env.reset(td.set("_reset", torch.tensor([[True], [False]])))
    assert component([env.step(td.set("action", pairs((-1.0, 0.0), 2)))["next"]], "action_rate") == [[0.0, -4.0]]


@pytest.mark.parametrize("num_envs", [None, 3])
def test_specs_hold(num_envs):
    reward = RewardConfig(clearance_penalty=-0.1, action_rate_penalty=-0.01, mover_contact_penalty=-1.0)
    env = make_env(world_n="maze", num_envs=num_envs, backend="warp", reward=reward, lidar_beams=32)
    check_env_specs(env)
    rollout = env.rollout(4)
    parts = rollout["next", "reward_components"]
    assert parts["action_rate"][..., 1:, :].max() < 0
    # Where there are no movers, nothing is paid for them.
    assert not parts["mover_contact"].any()
    torch.testing.assert_close(rollout["next", "reward"], sum(parts.values()))


def met(speed, contact, distance, before):
    """Results of a step and of the one before, of a rover for each entry of the lists."""
    rows = len(speed)
    last = TensorDict({"outcome": TensorDict({"linear_velocity": torch.tensor(before)[:, None]}, [rows])}, [rows])
    outcome = {"linear_velocity": speed, "mover_contact": contact, "mover_distance": distance}
    entries = {name: torch.tensor(values)[:, None] for name, values in outcome.items()}
    entries["phase"] = torch.full((rows, 1), int(StepEvent.DENSE))
    return last, TensorDict({"outcome": TensorDict(entries, [rows])}, [rows])


def test_a_contact_with_a_mover_costs_by_whose_fault_it_is_and_so_do_closeness_and_haste():
    penalty = rewards.MoverContactPenalty(RewardConfig(mover_contact_penalty=-2.0, struck_penalty=-0.5))
    # The mover pushes all of them in this step.
    results = met([0.5] * 4, [True, True, True, False], [0.1] * 4, before=[0.8, -0.3, 0.0, 0.8])
    assert component([penalty._step(*results)], "mover_contact") == [[-2.0, -2.0, -0.5, 0.0]]
    penalties = {"intrusion_penalty": -0.1, "haste_penalty": -0.4, "risk_penalty": -1.0}
    config = RewardConfig(**penalties, intrusion_distance=1.0, risk_distance=0.25)
    penalty = rewards.ConfiguredComponent(config, "mover_proximity")
    results = met([0.0, 1.0, -1.0, 1.0, 1.0], [False] * 5, [0.5, 0.5, 0.5, 0.2, math.inf], [0.0] * 5)
    assert component([penalty._step(*results)], "mover_proximity") == [[-0.05, -0.25, -0.25, -1.4, 0.0]]


class Haste(rewards.RewardComponent):
    name = "haste"

    def value(self, outcome, observation):
        return -1.0 * (~outcome["goal_reached"]).float()


class Caution(Haste):
    phases = (StepEvent.DENSE,)


@pytest.mark.parametrize(
    ("components", "pays"),
    [
        (contract_reward(), True),
        (rewards.reward_components("task"), True),
        ([Haste()], True),
        (contract_reward()[1:], False),
        ([Caution(), *contract_reward(RewardConfig(clearance_penalty=-1.0))[1:]], False),
    ],
)
def test_whether_a_reward_pays_for_a_goal(components, pays):
    assert rewards.pays_for_goals(components) == pays
