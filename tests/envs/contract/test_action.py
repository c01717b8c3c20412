"""Action space and heading controller."""

from __future__ import annotations

import math

import hypothesis
import pytest
import torch
from hypothesis import strategies as st
from torchrl.envs import EnvBase

from rover_rl.envs.config import HeadingGains
from rover_rl.envs.stages import HeadingController
from tests.envs import transcription as contract
from tests.envs.contract.scripted_env import FAR_GOAL, bare, pairs, scripted
from tests.envs.scripted import Moment


def test_the_action_space_is_speed_within_1_and_heading_offset_within_pi():
    spec = scripted([Moment()], [Moment()]).full_action_spec["action"]
    assert spec.shape == (2, 2)
    assert spec.dtype == torch.float32
    assert spec.space.low.tolist() == torch.tensor([[-1.0, -math.pi]] * 2).tolist()
    assert spec.space.high.tolist() == torch.tensor([[1.0, math.pi]] * 2).tolist()


def commands(env: EnvBase, actions: list[tuple[float, float]]) -> list[list[float]]:
    """Resets, then returns the twist commanded to row 0 for each action."""
    td = env.reset(goal=pairs(FAR_GOAL))
    sent = []
    for action in actions:
        td["action"] = pairs(action)
        td = env.step(td)["next"]
        sent.append(bare(env).simulator.commands[-1][0].tolist())
    return sent


def test_finite_actions_outside_of_their_bounds_are_clipped():
    inside, outside = ([(1.0, math.pi), (-1.0, 0.1)], [(5.0, 9.0), (-3.0, 0.1)])
    assert commands(scripted([Moment()]), outside) == commands(scripted([Moment()]), inside)


# Kept off the wrap at pi, where rounding could flip the sign of the error.
offsets = st.floats(-3.125, 3.125, width=32)
yaws = st.floats(-3.140625, 3.140625, width=32)


@hypothesis.settings(max_examples=60, deadline=None)
@hypothesis.given(
    headings=st.lists(st.tuples(offsets, yaws), min_size=1, max_size=8),
    ki=st.sampled_from([0.0, 0.5]),
    dt=st.sampled_from([0.05, 0.1]),
)
def test_the_heading_controller_is_the_contracts_pid(headings, ki, dt):
    controller = HeadingController(1, HeadingGains(ki=ki))
    pid = contract.HeadingPid(ki=ki)
    for offset, yaw in headings:
        desired, current = torch.tensor([[yaw + offset]]), torch.tensor([[yaw]])
        rate = controller(desired, current, torch.tensor([[dt]])).item()
        assert rate == pytest.approx(pid(yaw + offset, yaw, dt), abs=1e-4)


def test_rows_that_are_not_active_keep_their_controller():
    controller, column = HeadingController(2), torch.ones(2, 1)
    controller(0.2 * column, 0 * column, 0.05 * column)
    controller(0.5 * column, 0 * column, 0.05 * column, torch.tensor([[True], [False]]))
    rates = controller(0.5 * column, 0 * column, 0.05 * column).flatten().tolist()
    assert rates == pytest.approx([1.0, 1.0 + 0.1 * 0.3 / 0.05], abs=1e-5)
