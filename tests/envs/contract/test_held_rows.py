"""Held rows: those that TorchRL's ``_step`` mask excludes from a step."""

from __future__ import annotations

import torch

from rover_rl.envs.task import StepEvent
from tests.envs.contract.scripted_env import OBSERVATION, moving, pairs, play, scripted
from tests.envs.scripted import Moment


def test_held_rows_keep_observation_and_counters_get_no_reward_and_do_not_move():
    env = scripted(moving(9, speed=0.1), moving(9, speed=0.1))
    td = play(env, 3)[-1].clone()
    before = td.clone()
    td.update({"action": pairs((1.0, 0.5), 2), "_step": torch.tensor([True, False])})
    after = env.step(td)["next"]
    for key in OBSERVATION:
        assert torch.equal(after[key][1], before[key][1])
    for name in before["outcome"].keys():  # noqa: SIM118
        if name != "phase":
            assert torch.equal(after["outcome", name][1], before["outcome", name][1])
    assert after["outcome", "phase"].flatten().tolist() == [StepEvent.DENSE, StepEvent.NONE]
    assert after["outcome", "steps"].flatten().tolist() == [4, 3]
    assert after["reward"][1].item() == 0.0
    assert all(component[1].item() == 0.0 for component in after["reward_components"].values())
    assert after["reward"][0].item() > 0.0


def test_a_done_row_that_is_held_stays_done():
    env = scripted(moving(9), [Moment(), Moment(roll=2.0)])
    td = play(env, 1)[-1].clone()
    td.update({"action": pairs((0.0, 0.0), 2), "_step": torch.tensor([True, False])})
    after = env.step(td)["next"]
    assert after["terminated"].flatten().tolist() == [False, True]
    assert after["done"].flatten().tolist() == [False, True]
    assert after["outcome", "flipped"].flatten().tolist() == [False, True]
