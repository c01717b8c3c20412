"""Reward function: goal, progress, velocity, turn and collision, on scripted sensor values."""

from __future__ import annotations

import math

import pytest
import torch

from rover_rl.envs.task import heading_alignment
from tests.envs.contract.scripted_env import bare, moving, pairs, play, rewards, scripted
from tests.envs.scripted import Moment


def test_below_0_5_m_the_reward_is_100_and_the_episode_goes_on_with_a_new_goal():
    env = scripted([Moment(x=1.0), Moment(x=0.499)], [Moment(x=1.0), Moment(x=0.5)])
    result = play(env, 1, goal=(0.0, 0.0))[0]
    assert result["outcome", "goal_reached"].flatten().tolist() == [True, False]
    assert result["reward"][0].item() == 100.0
    assert result["reward"][1].item() < 1.0
    assert not result["done"].any()
    goals = bare(env).goal
    assert goals[0].tolist() != [0.0, 0.0]
    assert goals[1].tolist() == [0.0, 0.0]


def test_the_target_observed_after_a_goal_is_the_new_one_and_progress_restarts_on_it():
    env = scripted([Moment(x=1.0), Moment(), Moment(y=0.03, ranges=5.0)])
    first, second = play(env, 2, goal=(0.0, 0.0))
    goal = bare(env).goal[0].tolist()
    before, after = math.dist((0, 0), goal), math.dist((0, 0.03), goal)
    assert first["outcome", "progress"].item() == pytest.approx(1.0)
    assert first["target"][0, 0].item() == pytest.approx(before, abs=1e-6)
    assert second["outcome", "progress"].item() == pytest.approx(before - after, abs=1e-6)


def test_each_goal_of_an_episode_is_another_one():
    env = scripted([Moment(x=1.0), Moment()])
    td, goals = env.reset(goal=pairs((0.0, 0.0))), []
    for _ in range(5):
        td["action"] = pairs((0.0, 0.0))
        td = env.step(td)["next"]
        goals.append(tuple(bare(env).goal[0].tolist()))
        bare(env).simulator.scripts = [[Moment(*goals[-1])]]
    assert len(set(goals)) == 5


def test_the_bare_environments_reward_is_1_for_each_goal():
    env = scripted([Moment(x=1.0), Moment(x=0.7), Moment(), Moment()], reward="task")
    assert rewards(play(env, 3, goal=(0.0, 0.0))) == [0.0, 1.0, 0.0]


def test_end_on_goal_ends_the_episode_at_the_goal_and_keeps_it():
    env = scripted([Moment(x=1.0), Moment()], end_on_goal=True)
    result = play(env, 1, goal=(0.0, 0.0))[0]
    assert result["terminated"].item()
    assert not result["truncated"].item()
    assert result["reward"].item() == 100.0
    assert bare(env).goal.tolist() == [[0.0, 0.0]]


@pytest.mark.parametrize(("change", "paid"), [(0.0009, False), (-0.0009, False), (0.0011, True), (-0.0011, True)])
def test_a_change_of_0_001_m_or_less_costs_the_idle_penalty_times_1_5(change, paid):
    reward = play(scripted(moving(1, speed=change)), 1, goal=(2.0, 0.0))[0]["reward"].item()
    assert reward == pytest.approx(change * 0.45 if paid else -0.03 * 1.5, abs=1e-6)


@pytest.mark.parametrize(
    ("angle", "alignment"),
    [
        (0.0, 1.0),
        (math.pi / 4, 0.5),
        (-math.pi / 4, 0.5),
        (math.pi / 2, 0.0),
        (math.pi, -1.0),
        (-math.pi, -1.0),
    ],
)
def test_alignment_falls_from_1_straight_ahead_over_0_at_a_right_angle_to_minus_1(angle, alignment):
    assert heading_alignment(torch.tensor([angle])).item() == pytest.approx(alignment, abs=1e-6)


@pytest.mark.parametrize(("yaw", "paid"), [(0.0, True), (1.5, True), (-1.5, True), (1.6, False), (math.pi, False)])
def test_progress_counts_only_with_a_positive_heading_alignment(yaw, paid):
    reward = play(scripted(moving(1, speed=0.04, yaw=yaw)), 1)[0]["reward"].item()
    assert reward == pytest.approx(0.04 * 0.45 if paid else -0.045, abs=1e-5)


@pytest.mark.parametrize(("reading", "collides"), [(0.3, False), (0.299, True), (-math.inf, True), (math.nan, False)])
def test_a_reading_below_0_3_m_is_a_collision_that_costs_0_5_and_nothing_else(reading, collides):
    scan = [5.0] * 31 + [reading]
    result = play(scripted([Moment(v=1.0, w=1.0, ranges=scan)]), 1)[0]
    assert result["outcome", "collision"].item() is collides
    assert (result["reward"].item() == -0.5) is collides
    assert not result["done"].item()
