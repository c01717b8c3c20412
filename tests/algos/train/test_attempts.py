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


def ends(*lengths: int) -> SpreadEnds:
    transform = SpreadEnds(100)
    transform.lengths = torch.tensor(lengths)[:, None]
    return transform


def column(*values: Any) -> Tensor:
    return torch.tensor(values)[:, None]


def counted(counter: AttemptCounter, begun: Tensor, **step: Tensor) -> dict[str, list[int]]:
    """Counts of a step in which each row does something else."""
    before = TensorDict({"attempts": {"begun": begun}}, [len(begun)])
    terminated = step["phase"] < StepEvent.GOAL
    done = step.pop("truncated") | terminated
    after = TensorDict({"outcome": step, "done": done, "terminated": terminated}, [len(begun)])
    entries = counter._step(before, after)["attempts"]
    return {key: entries[key].flatten().tolist() for key in ("begun", "reached", "failed")}


def test_each_attempt_succeeds_or_fails() -> None:
    # Episodes of 600 steps: a reached goal, no event, a jam, the time limit, and a goal in the last step.
    counts = counted(
        AttemptCounter(ends(*[150] * 5), 4, 600),
        column(0, 100, 100, 300, 300),
        steps=column(120, 200, 208, 600, 600),
        goals=column(1, 0, 0, 0, 1),
        phase=column(GOAL, DENSE, JAM, DENSE, GOAL),
        truncated=column(False, False, False, True, True),
    )
    assert counts == {"begun": [120, 100, 100, 300, 600], "reached": [1, 0, 0, 0, 1], "failed": [0, 0, 1, 1, 0]}


def test_attempts_that_begin_too_late_do_not_count_however_they_end() -> None:
    # The time that is left is less than half of the longest episode: in the first row, whose episode is short, from
    # the start; in the others after step 300.
    counts = counted(
        AttemptCounter(ends(74, 150, 150, 150), 4, 600),
        column(0, 304, 304, 304),
        steps=column(100, 320, 320, 600),
        goals=column(1, 1, 0, 0),
        phase=column(GOAL, GOAL, JAM, DENSE),
        truncated=column(False, False, False, True),
    )
    assert counts["reached"] == counts["failed"] == [0, 0, 0, 0]


def test_a_goal_after_a_minute_is_a_failure() -> None:
    counts = counted(
        AttemptCounter(ends(1000, 1000), 4, 4000),
        column(0, 0),
        steps=column(1200, 1204),
        goals=column(1, 1),
        phase=column(GOAL, GOAL),
        truncated=column(False, False),
    )
    assert (counts["reached"], counts["failed"]) == ([1, 0], [0, 1])


@pytest.mark.parametrize(("phase", "failed"), [(GOAL, 0), (JAM, 1)])
def test_a_goal_and_an_ending_in_one_decision(phase: int, failed: int) -> None:
    """With end_on_goal, the goal ends the episode. A jam after it in the same decision ends the next attempt."""
    begun, steps, goals = column(0), column(120), column(1)
    outcome = {"steps": steps, "goals": goals, "phase": column(phase)}
    after = TensorDict({"outcome": outcome, "done": column(True), "terminated": column(True)}, [1])
    counter = AttemptCounter(ends(150), 4, 600)
    entries = counter._step(TensorDict({"attempts": {"begun": begun}}, [1]), after)["attempts"]
    assert (entries["reached"].item(), entries["failed"].item()) == (1, failed)


def test_a_new_episode_begins_a_new_attempt() -> None:
    reset = TensorDict({"outcome": {"steps": column(7)}}, [1])
    entries = AttemptCounter(ends(150), 4, 600)._reset(TensorDict({}, [1]), reset)["attempts"]
    assert [entries[key].item() for key in ("begun", "reached", "failed")] == [0, 0, 0]
