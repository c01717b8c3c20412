"""The success rate of training counts attempts as an evaluation does."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor

from rover_rl.algos.train.attempts import AttemptCounter, SpreadEnds
from rover_rl.envs.task import StepEvent

DENSE, JAM, GOAL = int(StepEvent.DENSE), int(StepEvent.JAM), int(StepEvent.GOAL)


def column(value: Any) -> Tensor:
    return torch.tensor([[value]])


def counter(end: int, longest: int) -> AttemptCounter:
    """Counts for a row whose episode is truncated after ``end`` decisions of four steps."""
    ends = SpreadEnds(100)
    ends.lengths = column(end)
    return AttemptCounter(ends, 4, longest)


@pytest.mark.parametrize(
    ("end", "longest", "begun", "steps", "goals", "phase", "ending", "expected"),
    [
        pytest.param(150, 600, 0, 120, 1, GOAL, "none", [120, 1, 0], id="a goal"),
        pytest.param(150, 600, 100, 200, 0, DENSE, "none", [100, 0, 0], id="no event"),
        pytest.param(150, 600, 100, 208, 0, JAM, "terminated", [100, 0, 1], id="a jam"),
        pytest.param(150, 600, 300, 600, 0, DENSE, "truncated", [300, 0, 1], id="the time limit"),
        pytest.param(150, 600, 300, 600, 1, GOAL, "truncated", [600, 1, 0], id="a goal in the last step"),
        # Attempts that begin too late do not count, however they end: the time that is left is less than half of the
        # longest episode, in a short episode from the start and in a long one after step 300.
        pytest.param(74, 600, 0, 100, 1, GOAL, "none", [100, 0, 0], id="too late in a short episode"),
        pytest.param(150, 600, 304, 320, 1, GOAL, "none", [320, 0, 0], id="too late and a goal"),
        pytest.param(150, 600, 304, 600, 0, DENSE, "truncated", [304, 0, 0], id="too late and the time limit"),
        pytest.param(1000, 4000, 0, 1200, 1, GOAL, "none", [1200, 1, 0], id="a goal within a minute"),
        pytest.param(1000, 4000, 0, 1204, 1, GOAL, "none", [1204, 0, 1], id="a goal after a minute"),
        # With end_on_goal, the goal ends the episode. A jam after it in the same decision ends the next attempt.
        pytest.param(150, 600, 0, 120, 1, GOAL, "terminated", [120, 1, 0], id="a goal that ends the episode"),
        pytest.param(150, 600, 0, 120, 1, JAM, "terminated", [120, 1, 1], id="a goal and a jam"),
    ],
)
def test_each_attempt_succeeds_fails_or_does_not_count(
    end: int, longest: int, begun: int, steps: int, goals: int, phase: int, ending: str, expected: list[int]
) -> None:
    outcome = {"steps": column(steps), "goals": column(goals), "phase": column(phase)}
    endings = {"done": column(ending != "none"), "terminated": column(ending == "terminated")}
    before = TensorDict({"attempts": {"begun": column(begun)}}, [1])
    after = TensorDict({"outcome": outcome, **endings}, [1])
    entries = counter(end, longest)._step(before, after)["attempts"]
    assert [entries[key].item() for key in ("begun", "reached", "failed")] == expected
