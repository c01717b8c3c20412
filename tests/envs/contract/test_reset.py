"""Reset: cleared state, partial resets, and validation of starts and goals."""

from __future__ import annotations

import math

import pytest
import torch

from rover_rl import TaskConfig
from rover_rl.envs.task import EVENTS, StepEvent
from tests.envs.contract.scripted_env import OBSERVATION, bare, moving, pairs, play, scripted
from tests.envs.scripted import Moment


def test_after_a_reset_nothing_has_happened():
    env = scripted([Moment(ranges=0.1, roll=2.0)])
    play(env, 1)
    td = env.reset()
    assert not any(td["outcome", event].any() for event in EVENTS)
    assert td["outcome", "phase"].item() == StepEvent.NONE
    assert td["outcome", "steps"].item() == 0
    assert td["outcome", "progress"].item() == 0
    assert not td["done"].any()


def test_a_reset_starts_the_collision_count_anew():
    env = scripted([Moment(ranges=0.1)])
    play(env, 10)
    assert not any(td["done"].any() for td in play(env, 15))


def test_the_position_history_does_not_survive_a_reset():
    env = scripted([Moment()], task=TaskConfig(stuck_window=30))
    play(env, 20)
    results = play(env, 30)
    assert [td["done"].item() for td in results] == [False] * 29 + [True]


def test_a_partial_reset_leaves_the_other_rows_as_they_are():
    env = scripted(moving(9, speed=0.1, ranges=0.1), moving(9, speed=0.1, ranges=0.1))
    td = play(env, 5)[-1].clone()
    goal = bare(env).goal
    td["_reset"] = torch.tensor([[True], [False]])
    after = env.reset(td.clone())
    assert after["outcome", "steps"].flatten().tolist() == [0, 5]
    for key in OBSERVATION:
        assert torch.equal(after[key][1], td[key][1])
    assert torch.equal(bare(env).goal[1], goal[1])
    # Ten more steps make 15 in collision for the second row; the next one is a jam.
    for k in range(11):
        after["action"] = pairs((0.0, 0.0), 2)
        after = env.step(after)["next"]
        assert after["terminated"].flatten().tolist() == [False, k == 10]


def test_a_start_or_goal_of_the_wrong_shape_or_not_finite_raises():
    env = scripted([Moment()], reward="task")
    with pytest.raises(ValueError, match="goal must be finite"):
        env.reset(goal=torch.zeros(2, 2))
    with pytest.raises(ValueError, match="start must be finite"):
        env.reset(start=torch.tensor([[0.0, 0.0, math.nan]]))
