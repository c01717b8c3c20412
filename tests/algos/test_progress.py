from __future__ import annotations

import math
from pathlib import Path

import torch
from rich.console import Console
from tensordict import TensorDict

from rover_rl.algos.progress import BatchStatistics, ProgressLog, read_progress


def batch(goal: str, terminated: str, truncated: str, total_steps: int) -> TensorDict:
    """A batch of one rover, a character a decision: ``x`` where it happened."""
    flags = {
        name: torch.tensor([[[c == "x"] for c in text]])
        for name, text in {"goal": goal, "terminated": terminated, "truncated": truncated}.items()
    }
    length = len(goal)
    outcome = {
        "goals": flags["goal"].long(),
        "goal_reached": flags["goal"],
        "steps": torch.full((1, length, 1), 40),
        "total_steps": torch.full((1, length, 1), total_steps),
    }
    after = {
        "outcome": outcome,
        "terminated": flags["terminated"],
        "done": flags["terminated"] | flags["truncated"],
        "episode_reward": torch.full((1, length, 1), -3.0),
    }
    return TensorDict({"next": after}, batch_size=(1, length))


def test_tries_end_at_goals_and_endings_but_not_at_the_time_limit() -> None:
    row = BatchStatistics(1, repeat=4)(batch("..x..x....", "........x.", "...x......", 40))
    assert (row["tries"], row["tries_reached"]) == (3, 2)
    assert row["episodes"] == 2
    assert row["goals_per_2000_steps"] == 2 * 2000 / 40
    assert (row["episode_steps"], row["episode_return"]) == (40, -3)


def test_a_try_fails_after_a_minute_across_batches() -> None:
    statistics = BatchStatistics(1, repeat=4)
    quiet = "." * 200
    assert statistics(batch(quiet, quiet, quiet, 800))["tries"] == 0
    row = statistics(batch(quiet, quiet, quiet, 1600))
    assert (row["tries"], row["tries_reached"], row["steps"]) == (1, 0, 1600)
    assert math.isnan(row["episode_return"])


def test_rows_are_appended_and_read_back(tmp_path: Path) -> None:
    path = tmp_path / "progress.csv"
    measured = {"goals_per_2000_steps": 1.5, "tries": 2, "tries_reached": 1, "episode_return": math.nan}
    with ProgressLog(path, Console(quiet=True)) as log:
        log.add(0.5, {"steps": 100, **measured})
        log.add(1.0, {"steps": 200, **measured})
    with path.open("a") as file:
        file.write("0.1,20")
    columns = read_progress(path)
    assert columns["steps"] == [100, 200]
    assert columns["tries"] == [2, 2]
    assert math.isnan(columns["episode_return"][0])
