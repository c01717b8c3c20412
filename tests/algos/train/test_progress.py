from __future__ import annotations

import math
from pathlib import Path

import pytest
import torch
from rich.console import Console
from tensordict import TensorDict

from rover_rl.algos.train.progress import ProgressLog, Stopwatch, batch_statistics, read_progress


def test_what_happened_in_a_batch_is_counted() -> None:
    done = torch.tensor([[False, True, False], [True, False, True]])[..., None]
    sums = torch.tensor([[0.0, 200.0, 0.0], [0.0, 0.0, 100.0]])[..., None]
    outcome = {
        "goals": torch.tensor([[1, 1, 0], [0, 0, 1]])[..., None],
        "steps": torch.tensor([[4, 8, 4], [40, 4, 6]])[..., None],
    }
    attempts = {"reached": outcome["goals"], "failed": torch.tensor([[0, 0, 0], [1, 0, 0]])[..., None]}
    after = {"outcome": outcome, "done": done, "episode_reward": sums - 3, "attempts": attempts}
    row = batch_statistics(TensorDict({"next": after}, batch_size=(2, 3)), repeat=4)
    assert row == {
        "goals_per_2000_steps": 3 * 2000 / 24,
        "episodes": 3,
        "attempts": 4,
        "attempts_reached": 3,
        "success_rate": 0.75,
        "episode_steps": 18,
        "episode_return": 97,
    }
    after["done"] = torch.zeros_like(done)
    row = batch_statistics(TensorDict({"next": after}, batch_size=(2, 3)), repeat=4)
    assert row["episodes"] == 0
    assert math.isnan(row["episode_return"])


MEASURED = {
    "goals_per_2000_steps": 1.5,
    "episodes": 2,
    "attempts": 2,
    "attempts_reached": 1,
    "episode_return": math.nan,
}


def test_rows_are_appended_and_read_back(tmp_path: Path) -> None:
    with ProgressLog(tmp_path, console=Console(quiet=True)) as log:
        log.add({"steps": 100, **MEASURED})
        log.add({"steps": 200, **MEASURED})
    path = tmp_path / "progress.csv"
    with path.open("a") as file:
        file.write("0.1,20")
    columns = read_progress(path)
    assert columns["steps"] == [100, 200]
    assert columns["episodes"] == [2, 2]
    assert math.isnan(columns["episode_return"][0])
    ProgressLog(tmp_path, updates=1, steps=100, console=Console(quiet=True))
    assert read_progress(path)["steps"] == [100]


def batch_of(clocks: list[tuple[float, float, float]], rows: int = 2) -> TensorDict:
    """Five decisions of workers, by their number and what each has worked so far in simulator and environment, s."""
    told = torch.tensor(clocks, dtype=torch.float64).repeat_interleave(rows, 0)[:, None].expand(-1, 5, -1)
    clock = dict(zip(("worker", "simulator", "environment"), told.split(1, -1), strict=True))
    return TensorDict({"next": {"clock": clock}}, batch_size=told.shape[:2])


def test_the_time_of_a_batch_is_divided_by_what_it_went_into() -> None:
    stopwatch = Stopwatch()
    with stopwatch("gradient steps"):
        pass
    # Two workers have worked 1 and 3 s, half of it in the simulator, and the batch was waited for 4 s.
    stopwatch.collected(batch_of([(0, 0.5, 1.0), (1, 1.5, 3.0)]), rows=2, waited=4.0)
    shares = stopwatch.shares()
    assert shares["simulator"] == pytest.approx(shares["task and rewards"], rel=1e-3)
    assert shares["policy and collector"] == pytest.approx(2 * shares["simulator"], rel=1e-3)
    assert sum(shares.values()) == pytest.approx(1, abs=1e-6 * shares["simulator"])
