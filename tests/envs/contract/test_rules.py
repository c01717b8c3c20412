"""The contract's numbers on scripted sensor values: thresholds, rewards, endings, and what a reset clears.

Whatever depends on them continuously is compared with the transcription in ``test_transcription.py``.
"""

from __future__ import annotations

import math
from itertools import product

import pytest
import torch

from rover_rl import RewardConfig, TaskConfig
from rover_rl.envs.task import EVENTS, PositionHistory, StepEvent, compute_terminations
from tests.envs.scripted import CPU, OBSERVATION, Moment, bare, moving, pairs, play, rewards, scripted, step_events

NEAR = Moment(ranges=0.1)
"""In collision."""


def done(results) -> list[bool]:
    return [td["done"].item() for td in results]


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
    order = ["FLIP", "JAM", "OUT_OF_BOUNDS", "STUCK", "GOAL", "COLLISION", "DENSE", "NONE"]
    assert [phase.name for phase in StepEvent] == ["INVALID_ACTION", *order]


@pytest.mark.parametrize(
    ("event", "ends", "before", "beyond"),
    [
        *(
            ("flipped", True, Moment(**{k: s * 1.479}), Moment(**{k: s * 1.481}))
            for k in ("roll", "pitch")
            for s in (-1, 1)
        ),
        ("collision", False, Moment(ranges=[5.0] * 31 + [0.3]), Moment(ranges=[5.0] * 31 + [0.299])),
        ("collision", False, Moment(ranges=[5.0] * 31 + [math.nan]), Moment(ranges=[5.0] * 31 + [-math.inf])),
        ("goal_reached", False, Moment(x=19.5), Moment(x=19.501)),
    ],
)
def test_an_event_begins_at_its_threshold(event, ends, before, beyond):
    result = play(scripted([Moment(), before], [Moment(), beyond]), 1)[0]
    assert result["outcome", event].flatten().tolist() == [False, True]
    assert result["terminated"].flatten().tolist() == [False, ends]


# Rewards


@pytest.mark.parametrize(
    ("script", "paid"),
    [
        *((moving(1, speed=change), abs(change) > 0.001) for change in (0.0009, -0.0009, 0.0011, -0.0011)),
        # Progress counts only with a positive heading alignment.
        *((moving(1, speed=0.04, yaw=yaw), abs(yaw) < math.pi / 2) for yaw in (0.0, 1.5, -1.5, 1.6, math.pi)),
    ],
)
def test_progress_pays_0_45_a_metre_and_idling_costs_0_045(script, paid):
    assert rewards(play(scripted(script), 1)) == pytest.approx([script[1].x * 0.45 if paid else -0.045], abs=1e-5)


def test_at_a_goal_the_reward_is_100_and_the_episode_goes_on_with_a_new_goal():
    env = scripted([Moment(x=1.0), Moment(), Moment(y=0.03, ranges=5.0)])
    first, second = play(env, 2, goal=(0.0, 0.0))
    assert first["reward"].item() == 100.0
    assert not first["done"].any()
    goal = bare(env).goal[0].tolist()
    before, after = math.dist((0, 0), goal), math.dist((0, 0.03), goal)
    assert before >= 1.0
    assert first["outcome", "progress"].item() == pytest.approx(1.0)
    assert first["target"][0, 0].item() == pytest.approx(before, abs=1e-6)
    assert second["outcome", "progress"].item() == pytest.approx(before - after, abs=1e-6)


def test_the_bare_environments_reward_is_1_for_each_goal():
    env = scripted([Moment(x=1.0), Moment(x=0.7), Moment(), Moment()], reward="task")
    assert rewards(play(env, 3, goal=(0.0, 0.0))) == [0.0, 1.0, 0.0]


def test_end_on_goal_ends_the_episode_at_the_goal_and_keeps_it():
    env = scripted([Moment(x=1.0), Moment()], end_on_goal=True)
    result = play(env, 1, goal=(0.0, 0.0))[0]
    assert (result["terminated"].item(), result["truncated"].item()) == (True, False)
    assert result["reward"].item() == 100.0
    assert bare(env).goal.tolist() == [[0.0, 0.0]]


# Endings


def test_a_flip_costs_20_after_the_grace_and_nothing_before():
    flips, reward = {1: 0.0, 50: 0.0, 51: -20.0}, RewardConfig(flip_grace_steps=50)
    results = play(scripted(*([*moving(step - 1), Moment(roll=2.0)] for step in flips), reward=reward), 51)
    for row, (step, paid) in enumerate(flips.items()):
        assert [td["terminated"][row].item() for td in results[:step]] == [False] * (step - 1) + [True]
        assert results[step - 1]["reward"][row].item() == paid


def test_more_than_15_steps_in_collision_in_a_row_are_a_jam_that_costs_20():
    results = play(scripted([Moment(), *[NEAR] * 15, Moment(), *[NEAR] * 16]), 32)
    assert rewards(results[16:]) == [-0.5] * 15 + [-20.0]
    assert step_events(results[16:]) == [StepEvent.COLLISION] * 15 + [StepEvent.JAM]
    assert done(results) == [False] * 31 + [True]
    assert results[-1]["outcome", "jammed"].item()
    assert results[-1]["outcome", "collision"].item()


def test_positions_of_the_window_less_than_0_001_m_apart_are_stuck_and_cost_25():
    # A window of 60 holds the positions after steps 1 to 60; the position after the reset is not in it.
    def script(moves_at: int, way: float = 0.01) -> list[Moment]:
        return [Moment(x=way * (k >= moves_at)) for k in range(62)]

    scripts = [script(0), script(1), script(2), script(60), script(61), script(60, 0.0009), script(60, 0.0011)]
    results = play(scripted(*scripts, task=TaskConfig(stuck_window=60)), 60)
    assert results[-1]["outcome", "stuck"].flatten().tolist() == [True, True, False, False, True, True, False]
    assert not any(td["done"].any() for td in results[:-1])
    assert results[-1]["reward"][0].item() == -25.0
    assert results[-1]["outcome", "phase"][0].item() == StepEvent.STUCK
    assert rewards(results[:-1]) == [-0.045] * 59


def test_the_position_history_of_rows_that_take_no_step_does_not_move():
    history = PositionHistory(2, 3, CPU)
    for k in range(1, 4):
        displacement = history.displacement(torch.tensor([[k, k], [1.0, 1.0]]), torch.tensor([[k], [1]]))
    assert displacement[0].item() == pytest.approx(math.hypot(2, 2))
    assert displacement[1].item() == math.inf


@pytest.mark.parametrize("length", [1, 7])
def test_an_episode_is_truncated_at_its_length(length):
    results = play(scripted(moving(length), reward="task", length=length), length)
    assert [td["truncated"].item() for td in results] == done(results) == [False] * (length - 1) + [True]
    assert not results[-1]["terminated"].item()


# Resets


def test_after_a_reset_nothing_has_happened():
    env = scripted([Moment(ranges=0.1, roll=2.0)])
    play(env, 1)
    td = env.reset()
    assert not any(td["outcome", event].any() for event in EVENTS)
    assert td["outcome", "phase"].item() == StepEvent.NONE
    assert (td["outcome", "steps"].item(), td["outcome", "total_steps"].item()) == (0, 1)
    assert td["outcome", "progress"].item() == 0
    assert not td["done"].any()


def test_a_reset_clears_the_collision_count_and_the_position_history():
    env = scripted([NEAR])
    play(env, 10)
    assert not any(done(play(env, 15)))
    env = scripted([Moment()], task=TaskConfig(stuck_window=30))
    play(env, 20)
    assert done(play(env, 30)) == [False] * 29 + [True]


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


def test_a_done_row_that_is_held_stays_done():
    env = scripted(moving(9), [Moment(), Moment(roll=2.0)])
    td = play(env, 1)[-1].clone()
    td.update({"action": pairs((0.0, 0.0), 2), "_step": torch.tensor([True, False])})
    after = env.step(td)["next"]
    for flags in (after["terminated"], after["done"], after["outcome", "flipped"]):
        assert flags.flatten().tolist() == [False, True]
