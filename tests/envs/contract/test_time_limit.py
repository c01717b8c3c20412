"""Time limit and step counters."""

from __future__ import annotations

import pytest

from tests.envs.contract.scripted_env import moving, play, scripted
from tests.envs.scripted import Moment


def test_an_episode_is_truncated_at_2000_steps_by_default():
    results = play(scripted(moving(2000), reward="task"), 2000)
    assert [td["truncated"].item() for td in results] == [False] * 1999 + [True]
    assert results[-1]["done"].item()
    assert not results[-1]["terminated"].item()


@pytest.mark.parametrize("length", [1, 7])
def test_an_episode_is_truncated_at_its_length(length):
    results = play(scripted(moving(length), length=length), length)
    assert [td["truncated"].item() for td in results] == [False] * (length - 1) + [True]


def test_an_ending_at_the_time_limit_is_terminated():
    result = play(scripted([Moment(roll=2.0)], length=1), 1)[0]
    assert result["terminated"].item()
    assert result["done"].item()


def test_steps_count_the_episode_and_total_steps_the_rows_life():
    env = scripted(moving(3))
    play(env, 3)
    outcome = play(env, 2)[-1]["outcome"]
    assert (outcome["steps"].item(), outcome["total_steps"].item()) == (2, 5)
