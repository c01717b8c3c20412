from __future__ import annotations

import math
from pathlib import Path

import torch
from rich.console import Console
from tensordict import TensorDict

from rover_rl.algos.progress import BatchStatistics, ProgressLog, read_progress


def test_what_happened_in_a_batch_is_counted() -> None:
    statistics = BatchStatistics()
    done = torch.tensor([[False, True, False], [True, False, True]])[..., None]
    sums = torch.tensor([[0.0, 200.0, 0.0], [0.0, 0.0, 100.0]])[..., None]
    outcome = {
        "goals": torch.tensor([[1, 1, 0], [0, 0, 1]])[..., None],
        "steps": torch.tensor([[4, 8, 4], [40, 4, 6]])[..., None],
        "total_steps": torch.tensor([[4, 8, 12], [40, 44, 46]])[..., None],
    }
    after = {"outcome": outcome, "done": done, "episode_reward": sums - 3, "episode_goal_reward": sums}
    row = statistics(TensorDict({"next": after}, batch_size=(2, 3)))
    assert row == {
        "steps": 58,
        "goals_per_2000_steps": 3 * 2000 / 58,
        "episodes": 3,
        "episodes_reached": 2,
        "episode_steps": 18,
        "episode_return": 97,
    }
    outcome["total_steps"] = outcome["total_steps"] + 8
    after["done"] = torch.zeros_like(done)
    row = statistics(TensorDict({"next": {**after, "outcome": outcome}}, batch_size=(2, 3)))
    assert row["steps"] == 74
    assert row["goals_per_2000_steps"] == 3 * 2000 / 16
    assert row["episodes"] == 0
    assert math.isnan(row["episode_return"])


def test_rows_are_appended_and_read_back(tmp_path: Path) -> None:
    path = tmp_path / "progress.csv"
    measured = {"goals_per_2000_steps": 1.5, "episodes": 2, "episodes_reached": 1, "episode_return": math.nan}
    with ProgressLog(path, Console(quiet=True)) as log:
        log.add(0.5, {"steps": 100, **measured})
        log.add(1.0, {"steps": 200, **measured})
    with path.open("a") as file:
        file.write("0.1,20")
    columns = read_progress(path)
    assert columns["steps"] == [100, 200]
    assert columns["episodes"] == [2, 2]
    assert math.isnan(columns["episode_return"][0])
