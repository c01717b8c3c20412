"""Stuck detection: the displacement over the last 600 positions."""

from __future__ import annotations

import math

import pytest
import torch

from rover_rl import TaskConfig
from rover_rl.envs.task import PositionHistory, StepEvent
from tests.envs.contract.scripted_env import CPU, moving, play, rewards, scripted
from tests.envs.scripted import Moment


def test_600_positions_less_than_0_001_m_apart_are_stuck_and_cost_25():
    results = play(scripted([Moment()]), 600)
    assert [td["done"].item() for td in results] == [False] * 599 + [True]
    assert results[-1]["reward"].item() == -25.0
    assert results[-1]["outcome", "phase"].item() == StepEvent.STUCK
    assert rewards(results[:-1]) == [-0.045] * 599


def test_the_600_positions_of_the_stuck_window_span_599_displacements():
    # The window holds the positions after steps 1 to 600; the position after the reset is not in it.
    def script(moves_at: int) -> list[Moment]:
        return [Moment(x=0.01 * (k >= moves_at)) for k in range(602)]

    results = play(scripted(script(1), script(2), script(600), script(601)), 600)
    assert results[-1]["outcome", "stuck"].flatten().tolist() == [True, False, False, True]
    assert not any(td["done"].any() for td in results[:-1])


@pytest.mark.parametrize(("moved", "stuck"), [(0.0009, True), (0.0011, False)])
def test_stuck_is_a_displacement_below_0_001_m(moved, stuck):
    results = play(scripted([Moment(), *[Moment()] * 29, Moment(x=moved)], task=TaskConfig(stuck_window=30)), 30)
    assert results[-1]["outcome", "stuck"].item() is stuck


def test_only_the_oldest_and_the_newest_position_count_for_stuck():
    excursion = [Moment(), Moment(), *[Moment(x=1.0)] * 28, Moment()]
    results = play(scripted(excursion, task=TaskConfig(stuck_window=30)), 30)
    assert results[-1]["outcome", "stuck"].item()


def test_the_stuck_window_slides():
    results = play(scripted(moving(10), task=TaskConfig(stuck_window=30)), 39)
    assert [td["done"].item() for td in results] == [False] * 38 + [True]


def test_the_position_history_of_rows_that_are_not_active_does_not_move():
    history = PositionHistory(2, 3, CPU)
    active = torch.tensor([[True], [False]])
    for k in range(1, 4):
        steps = torch.tensor([[k], [1]])
        displacement = history.displacement(torch.full((2, 2), float(k)), steps, None if k == 1 else active)
    assert displacement[0].item() == pytest.approx(math.hypot(2, 2))
    assert displacement[1].item() == math.inf
