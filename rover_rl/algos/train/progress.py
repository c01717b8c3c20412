"""Training progress: statistics of each batch, the table ``progress.csv`` and the progress bar."""

from __future__ import annotations

import csv
import math
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from statistics import harmonic_mean
from typing import Any

import torch
from rich.console import Console
from tensordict import TensorDictBase

from rover_rl.envs.config import EnvConfig
from rover_rl.envs.transforms.step_clock import NAMES
from rover_rl.files import errors_name, written_whole
from rover_rl.progress import ProgressDisplay

EPISODE_STEPS = EnvConfig.length  # number of steps of a full episode in the contract
TIME = "time_"  # prefix of the columns that hold the shares of the session's time so far
_LINE_INTERVAL = 6.0  # longest time between two lines if the output is not a terminal, s
_RECENT_STEPS = 80_000  # number of latest steps over which the progress bar averages


def batch_statistics(batch: TensorDictBase, repeat: int) -> dict[str, float]:
    """Returns statistics of a batch of decisions ``[N, T]``, with unscaled rewards; means over no episodes are nan.

    The success rate of training is ``attempts_reached / attempts``: each attempt to reach a goal succeeds or fails
    (:class:`~rover_rl.algos.train.attempts.AttemptCounter`). It is measured with exploration and with the decisions of
    training, so that an evaluation of the same policy may give another one. A decision in which the episode ends counts
    as ``repeat`` steps as all others, so that the number of steps of a run does not depend on its events.
    """
    after = batch["next"]
    outcome, ended = after["outcome"], after["done"]
    reached, failed = (int(after["attempts", key].sum()) for key in ("reached", "failed"))
    return {
        "goals_per_2000_steps": int(outcome["goals"].sum()) * EPISODE_STEPS / (batch.numel() * repeat),
        "episodes": int(ended.sum()),
        "attempts": reached + failed,
        "attempts_reached": reached,
        "success_rate": reached / (reached + failed) if reached + failed else math.nan,
        "episode_steps": outcome["steps"][ended].float().mean().item(),
        "episode_return": after["episode_reward"][ended].mean().item(),
    }


class Stopwatch:
    """Measures how the wall-clock time of training is spent.

    ``with stopwatch("gradient steps"):`` measures activities of the training process. Of the time spent waiting for a
    batch, the shares of the simulator and of the environment are those that its workers have measured
    (:class:`~rover_rl.envs.transforms.step_clock.StepClock`).
    """

    def __init__(self) -> None:
        self._started = time.perf_counter()
        self._seconds = dict.fromkeys(("simulator", "task and rewards", "policy and collector", "gradient steps"), 0.0)
        self._clocks: dict[float, list[float]] = {}

    @property
    def elapsed(self) -> float:
        return time.perf_counter() - self._started

    @contextmanager
    def __call__(self, name: str) -> Iterator[None]:
        started = time.perf_counter()
        try:
            yield
        finally:
            self._seconds[name] = self._seconds.get(name, 0.0) + time.perf_counter() - started

    def collected(self, batch: TensorDictBase, rows: int, waited: float) -> None:
        """Divides the time spent waiting for a batch, s, among the activities of its workers of ``rows`` rows each."""
        clock = batch["next", "clock"]
        worked = []
        for worker, *times in torch.cat([clock[name] for name in NAMES], -1)[::rows, -1].tolist():
            worked.append([new - old for new, old in zip(times, self._clocks.get(worker, (0.0, 0.0)), strict=True)])
            self._clocks[worker] = times
        simulator, environment = (sum(seconds) / len(worked) for seconds in zip(*worked, strict=True))
        waited_share = min(1.0, waited / environment)
        self._seconds["simulator"] += waited_share * simulator
        self._seconds["task and rewards"] += waited_share * (environment - simulator)
        self._seconds["policy and collector"] += waited - waited_share * environment

    def shares(self) -> dict[str, float]:
        elapsed = self.elapsed
        shares = {name: seconds / elapsed for name, seconds in self._seconds.items()}
        return shares | {"other": 1 - sum(shares.values())}


def time_columns(shares: Mapping[str, float]) -> dict[str, float]:
    return {TIME + name.replace(" ", "_"): share for name, share in shares.items()}


class ProgressLog:
    """Writes one row per batch to ``progress.csv``, and shows recent means in a progress bar.

    A resumed run keeps as many rows as its saved state had ``updates``, because the batches after it are collected
    again. The table keeps its columns: values of other names are left out, and missing ones are nan.
    """

    def __init__(self, folder: Path, updates: int = 0, steps: int = 0, console: Console | None = None) -> None:
        self._path = folder / "progress.csv"
        self._recent: list[dict[str, float]] = []
        self._steps, self._clock = steps, time.perf_counter()
        self._columns = _keep_rows(self._path, updates)
        self._display = ProgressDisplay("training", keep=True, tenths=True, console=console, interval=_LINE_INTERVAL)

    def __enter__(self) -> ProgressLog:
        self._clock = time.perf_counter()
        self._display.__enter__()
        return self

    def __exit__(self, *raised: Any) -> None:
        self._display.__exit__(*raised)

    def add(self, row: dict[str, float]) -> dict[str, float]:
        """Writes a row of values by name, with at least ``steps``, and returns it with the speed."""
        now = time.perf_counter()
        row = {**row, "steps_per_second": (row["steps"] - self._steps) / (now - self._clock)}
        self._steps, self._clock = int(row["steps"]), now
        self._recent = [*(r for r in self._recent if r["steps"] > row["steps"] - _RECENT_STEPS), row]
        new = not self._path.exists()
        self._columns = self._columns or list(row)
        with errors_name(self._path), self._path.open("a", newline="") as file:
            writer = csv.DictWriter(file, self._columns, restval=math.nan, extrasaction="ignore")
            if new:
                writer.writeheader()
            writer.writerow({key: f"{value:.6g}" if isinstance(value, float) else value for key, value in row.items()})
        return row

    def show(self, share: float) -> None:
        # Rows have equal numbers of steps, so the mean speed is the harmonic mean. The speed of a single row varies,
        # because batches may arrive in pairs.
        speed = harmonic_mean(row["steps_per_second"] for row in self._recent)
        attempts, reached = (sum(row[key] for row in self._recent) for key in ("attempts", "attempts_reached"))
        status = (
            f"{speed:,.0f} steps/s, "
            f"{self._mean('goals_per_2000_steps'):.1f} goals per 2,000 steps, "
            f"success {f'{reached / attempts:.0%}' if attempts else '-'} while exploring, "
            f"return {self._mean('episode_return'):.0f}"
        )
        self._display.update(share, status)

    def say(self, text: str) -> None:
        self._display.say(text)

    def _mean(self, key: str) -> float:
        values = [row[key] for row in self._recent if not math.isnan(row[key])]
        return sum(values) / len(values) if values else math.nan


def _keep_rows(path: Path, updates: int) -> list[str]:
    if not updates:
        path.unlink(missing_ok=True)
    if not path.exists():
        return []
    with path.open(newline="") as file:
        kept = file.readlines()[: updates + 1]
    with written_whole(path) as temporary:
        temporary.write_text("".join(kept), newline="")
    return next(csv.reader(kept), [])


def read_progress(path: Path) -> dict[str, list[float]]:
    """Reads the columns of a table that :class:`ProgressLog` wrote, without an incomplete last row."""
    with path.open(newline="") as file:
        rows = [row for row in csv.DictReader(file) if None not in row.values()]
    return {key: [float(row[key]) for row in rows] for key in (rows[0] if rows else ())}
