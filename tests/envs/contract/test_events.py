"""Step events: their order of precedence, flips, jams and leaving the bounds."""

from __future__ import annotations

import math
from itertools import product

import pytest
import torch

from rover_rl import TaskConfig
from rover_rl.envs.task import EVENTS, StepEvent, compute_terminations
from tests.envs.contract.scripted_env import moving, play, rewards, scripted, step_events
from tests.envs.scripted import Moment


def events_of_one_row(*, invalid=False, flip=False, jam=False, out=False, stuck=False, goal=False, collision=False):
    """Events and deciding event of one row in which the given conditions hold."""
    return compute_terminations(
        position=torch.tensor([[5.0 if out else 0.0, 0.0]]),
        tilt=torch.tensor([[0.0, -1.6 if flip else 0.0]]),
        distance=torch.tensor([[0.4 if goal else 3.0]]),
        displacement=torch.tensor([[0.0 if stuck else math.inf]]),
        collision_steps=torch.tensor([[16 if jam else int(collision)]]),
        invalid=torch.tensor([[invalid]]),
        bounds=(torch.tensor([[-4.0, -4.0]]), torch.tensor([[4.0, 4.0]])),
        config=TaskConfig(),
    )


def test_rules_decide_in_the_contracts_order():
    names = ("invalid", "flip", "jam", "out", "stuck", "goal", "collision")
    for chosen in product([False, True], repeat=len(names)):
        events, phase = events_of_one_row(**dict(zip(names, chosen, strict=True)))
        assert phase.item() == (chosen.index(True) if True in chosen else StepEvent.DENSE)
        invalid, flip, jam, out, stuck, goal, collision = chosen
        ended = invalid or flip or jam or out or stuck
        # All events are reported, not only the deciding one. A jam is a collision, and an ending rules out a goal.
        expected = [invalid, flip, jam, out, stuck, goal and not ended, collision or jam]
        assert dict(zip(EVENTS, events[0].tolist(), strict=True)) == dict(zip(EVENTS, expected, strict=True))


def test_phases_are_numbered_in_the_contracts_order():
    order = ["FLIP", "JAM", "OUT_OF_BOUNDS", "STUCK", "GOAL", "COLLISION", "DENSE", "NONE"]
    assert [phase.name for phase in StepEvent] == ["INVALID_ACTION", *order]


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("axis", ["roll", "pitch"])
def test_beyond_1_48_rad_of_roll_or_pitch_the_rover_is_flipped(axis, sign):
    env = scripted(*([Moment(**{axis: sign * angle})] for angle in (1.479, 1.481, 1.56)))
    result = play(env, 1)[0]
    assert result["outcome", "flipped"].flatten().tolist() == [False, True, True]
    assert result["terminated"].flatten().tolist() == [False, True, True]


def test_a_rover_on_its_back_is_flipped():
    result = play(scripted([Moment(roll=3.1)], [Moment(pitch=3.1)]), 1)[0]
    assert result["outcome", "flipped"].all()


@pytest.mark.parametrize(("step", "reward"), [(1, 0.0), (500, 0.0), (501, -20.0), (502, -20.0)])
def test_a_flip_costs_20_after_step_500_and_nothing_before(step, reward):
    script = moving(step - 1)
    result = play(scripted([*script, Moment(x=script[-1].x, roll=2.0)]), step)[-1]
    assert result["terminated"].item()
    assert result["reward"].item() == reward


def test_more_than_15_steps_in_collision_are_a_jam_that_costs_20():
    results = play(scripted([Moment(), Moment(ranges=0.1)]), 16)
    assert rewards(results) == [-0.5] * 15 + [-20.0]
    assert step_events(results) == [StepEvent.COLLISION] * 15 + [StepEvent.JAM]
    assert [td["terminated"].item() for td in results] == [False] * 15 + [True]
    assert results[-1]["outcome", "jammed"].item()
    assert results[-1]["outcome", "collision"].item()


def test_a_step_without_collision_starts_the_count_anew():
    near, free = Moment(ranges=0.1), Moment()
    results = play(scripted([free, *[near] * 15, free, *[near] * 16]), 32)
    assert [td["terminated"].item() for td in results] == [False] * 31 + [True]


def test_a_goal_reached_in_a_collision_pays_and_counts_as_a_step_in_collision():
    near, far = Moment(x=0.1, ranges=0.1), Moment(x=3.0, ranges=0.1)
    results = play(scripted([far, *[far] * 7, near, *[Moment(x=30.0, ranges=0.1)] * 8]), 16, goal=(0.0, 0.0))
    assert rewards(results) == [-0.5] * 7 + [100.0] + [-0.5] * 7 + [-20.0]
