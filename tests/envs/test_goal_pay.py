"""A reward that pays for no goal is found before it is trained with."""

from __future__ import annotations

import pytest
from torchrl.envs import Transform

from rover_rl.envs.goal_pay import pays_for_goals
from rover_rl.envs.rewards import ClearancePenalty, RewardComponent, RewardConfig, contract_reward, reward_components
from rover_rl.envs.task import StepEvent


class Tilt(RewardComponent):
    name = "tilt"

    def value(self, outcome, observation):
        return -0.1 * observation["imu"][:, :2].abs().sum(-1, keepdim=True)


class Caution(Tilt):
    name = "caution"
    phases = (StepEvent.DENSE,)


class Haste(RewardComponent):
    name = "haste"

    def value(self, outcome, observation):
        return -1.0 * (~outcome["goal_reached"]).float()


class GentleArrival(RewardComponent):
    name = "gentle"

    def value(self, outcome, observation):
        return 50.0 * (outcome["goal_reached"] & (outcome["linear_velocity"] < 0.3)).float()


class OfAnotherTransform(RewardComponent):
    name = "other"

    def value(self, outcome, observation):
        return observation["route"].sum(-1, keepdim=True)


@pytest.mark.parametrize(
    "components",
    [
        contract_reward(),
        [Tilt(), *contract_reward()],
        reward_components("task"),
        [Haste()],
        [GentleArrival()],
        [OfAnotherTransform()],
    ],
)
def test_rewards_that_pay_for_a_goal(components: list[Transform]) -> None:
    assert pays_for_goals(components)


@pytest.mark.parametrize(
    "components",
    [
        contract_reward()[1:],
        contract_reward(RewardConfig(goal_reward=0.0)),
        [Tilt()],
        [Caution(), ClearancePenalty(-1.0)],
    ],
)
def test_rewards_that_do_not(components: list[Transform]) -> None:
    assert not pays_for_goals(components)
