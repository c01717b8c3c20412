"""Held rows: those that TorchRL's ``_step`` mask excludes from a step."""

from __future__ import annotations

import torch

from rover_rl import make_env
from rover_rl.envs.task import StepEvent
from tests.envs.contract.scripted_env import OBSERVATION, bare, moving, pairs, play, random_actions, scripted
from tests.envs.scripted import Moment


def test_held_rows_stand_still_in_bullet_and_then_go_on_as_if_nothing_had_happened():
    rows, before, held_for, after = 4, 6, 5, 5
    active, held = [0, 2], [1, 3]
    mask = torch.tensor([True, False, True, False])
    env, twin = (make_env(world_n="maze", num_envs=rows, seed=3, lidar_beams=32) for _ in range(2))

    def step(each, td, k):
        return each.step(td.set("action", random_actions(k, rows)))["next"]

    twin_td, twin_results = twin.reset(), []
    for k in range(before + after):
        twin_td = step(twin, twin_td, k)
        twin_results.append(twin_td)
    td = env.reset()
    for k in range(before):
        td = step(env, td, k)
    state, scan = bare(env).rover_state.clone(), bare(env).scan.clone()
    observation = td.select(*OBSERVATION).clone()
    for k in range(before, before + held_for):
        td = step(env, td.set("_step", mask), k)
        held_state = bare(env).rover_state
        for raw in ("position", "orientation", "linear_velocity", "angular_velocity", "stamp"):
            assert torch.equal(getattr(held_state, raw)[held], getattr(state, raw)[held])
        assert torch.equal(bare(env).scan[held], scan[held])
        assert (td.select(*OBSERVATION)[held] == observation[held]).all()
        assert not td["reward"][held].any()
        assert td["outcome", "phase"][held].eq(StepEvent.NONE).all()
        # The other rows are unaffected.
        keys = (*OBSERVATION, "reward")
        assert (td.select(*keys)[active] == twin_results[k].select(*keys)[active]).all()
    assert td["outcome", "steps"].flatten().tolist() == [11, 6, 11, 6]
    # The held rows now follow the twin, except that the solver has to find its contacts again.
    for k in range(before, before + after):
        td = step(env, td, k)
        actual, expected = td[held], twin_results[k][held]
        tolerance = 1e-3 if k == before else 1e-2
        torch.testing.assert_close(actual["pose"], expected["pose"], atol=tolerance, rtol=0)
        torch.testing.assert_close(actual["imu"], expected["imu"], atol=2e-2, rtol=0)
        assert torch.equal(actual["outcome", "steps"], expected["outcome", "steps"])


def test_a_done_row_that_is_held_stays_done():
    env = scripted(moving(9), [Moment(), Moment(roll=2.0)])
    td = play(env, 1)[-1].clone()
    td.update({"action": pairs((0.0, 0.0), 2), "_step": torch.tensor([True, False])})
    after = env.step(td)["next"]
    for flags in (after["terminated"], after["done"], after["outcome", "flipped"]):
        assert flags.flatten().tolist() == [False, True]
