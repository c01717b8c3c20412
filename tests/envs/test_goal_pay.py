"""A reward that pays for no goal is found before it is trained with."""

from __future__ import annotations

import pytest
from torchrl.envs import Transform

from rover_rl.envs.rewards import (
    ClearancePenalty,
    RewardComponent,
    RewardConfig,
    contract_reward,
    pays_for_goals,
    reward_components,
)
from rover_rl.envs.task import StepEvent


class Tilt(RewardComponent):
    """Active in every step, and written for batches."""

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
    ("components", "pays"),
    [
        (contract_reward(), True),
        ([Tilt(), *contract_reward()], True),
        (reward_components("task"), True),
        ([Haste()], True),
        ([GentleArrival()], True),
        ([OfAnotherTransform()], True),
        (contract_reward()[1:], False),
        (contract_reward(RewardConfig(goal_reward=0.0)), False),
        ([Tilt()], False),
        ([Caution(), ClearancePenalty(-1.0)], False),
    ],
)
def test_whether_a_reward_pays_for_a_goal(components: list[Transform], pays: bool) -> None:
    assert pays_for_goals(components) == pays
