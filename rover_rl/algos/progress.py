"""How training goes: what is counted in each batch, the table on disk and the progress bar."""

from __future__ import annotations

import csv
import math
import time
from pathlib import Path
from types import TracebackType

import torch
from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn
from tensordict import TensorDictBase
from torch import Tensor

from rover_rl.algos.config import SECONDS_PER_STEP

TIME_LIMIT = 60.0
"""Seconds in which a goal has to be reached to count as a success, in training and in evaluation."""
EPISODE_STEPS = 2000
"""Steps of a full episode, as the contract has it."""
_RECENT = 10
"""Batches that the progress bar looks back over."""


class BatchStatistics:
    """Counts what happened in batches of decisions that follow one another.

    A goal is *tried* until it is reached, until the episode ends badly, or for 60 s, whichever comes first;
    after 60 s the same goal counts as tried anew. The success rate is the share of tries that reached their
    goal; tries that the end of a full episode cuts short do not count. Rovers that succeed soon try more often,
    so that this is higher than what :func:`~rover_rl.algos.evaluate.evaluate` finds.

    Args:
        num_envs: rows of a batch.
        repeat: steps a decision.
    """

    def __init__(self, num_envs: int, repeat: int) -> None:
        self._limit = math.ceil(TIME_LIMIT / SECONDS_PER_STEP / repeat)
        self._tried = torch.zeros(num_envs, dtype=torch.int64)
        self.steps = 0

    def __call__(self, batch: TensorDictBase) -> dict[str, float]:
        """Statistics of the next batch ``[N, T]``, rewards unscaled; nan where there is nothing to count."""
        after = batch["next"]
        outcome = after["outcome"]
        before, self.steps = self.steps, int(outcome["total_steps"][:, -1].sum())
        goals = int(outcome["goals"].sum())
        reached, failed = self._tries(outcome["goal_reached"], after["terminated"], after["done"])
        ended = after["done"]
        return {
            "steps": self.steps,
            "goals_per_2000_steps": goals * EPISODE_STEPS / max(self.steps - before, 1),
            "tries": reached + failed,
            "tries_reached": reached,
            "episodes": int(ended.sum()),
            "episode_steps": outcome["steps"][ended].float().mean().item(),
            "episode_return": after["episode_reward"][ended].mean().item(),
        }

    def _tries(self, goal: Tensor, terminated: Tensor, done: Tensor) -> tuple[int, int]:
        """How many tries reached their goal and how many failed, from flags ``[N, T, 1]``."""
        reached = failed = 0
        for now_goal, now_terminated, now_done in zip(
            *(flag.squeeze(-1).unbind(1) for flag in (goal, terminated, done)), strict=True
        ):
            self._tried += 1
            lost = now_terminated | (~now_goal & ~now_done & (self._tried >= self._limit))
            reached += int(now_goal.sum())
            failed += int(lost.sum())
            self._tried.masked_fill_(now_goal | now_done | lost, 0)
        return reached, failed


class ProgressLog:
    """Appends a row a batch to a table, and shows the latest of them in a progress bar.

    Without a terminal, a line is printed at each tenth of the way.

    Args:
        path: of the table (CSV).
        console: to print to.
    """

    def __init__(self, path: Path, console: Console | None = None) -> None:
        self._path = path
        self._recent: list[dict[str, float]] = []
        self._started = self._last = time.perf_counter()
        self._told = 0
        self._bar = Progress(
            TextColumn("training"),
            BarColumn(20),
            TaskProgressColumn(),
            TimeElapsedColumn(),
            TextColumn("{task.fields[status]}"),
            console=console,
            disable=not (console or Console()).is_terminal,
        )
        self._task = self._bar.add_task("", total=1.0, status="starting")

    @property
    def minutes(self) -> float:
        """Since training began."""
        return (time.perf_counter() - self._started) / 60

    def __enter__(self) -> ProgressLog:
        self._bar.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._bar.stop()

    def add(self, share: float, row: dict[str, float]) -> None:
        """Writes a row, of which ``steps`` is one entry; ``share`` of the training is done."""
        now = time.perf_counter()
        before = self._recent[-1]["steps"] if self._recent else 0
        row = {
            "minutes": self.minutes,
            "steps_per_second": (row["steps"] - before) / (now - self._last),
            **row,
        }
        self._last = now
        self._recent = [*self._recent[1 - _RECENT :], row]
        self._append(row)
        self._show(min(share, 1.0))

    def _append(self, row: dict[str, float]) -> None:
        new = not self._path.exists()
        with self._path.open("a", newline="") as file:
            writer = csv.DictWriter(file, list(row))
            if new:
                writer.writeheader()
            writer.writerow({key: f"{value:.6g}" if isinstance(value, float) else value for key, value in row.items()})

    def _show(self, share: float) -> None:
        status = (
            f"{self._mean('steps_per_second'):,.0f} steps/s, "
            f"{self._mean('goals_per_2000_steps'):.1f} goals per 2,000 steps, "
            f"success {self._success_rate():.0%}, return {self._mean('episode_return'):.0f}"
        )
        self._bar.update(self._task, completed=share, status=status)
        if self._bar.disable and int(share * 10) > self._told:
            self._told = int(share * 10)
            self._bar.console.print(f"{share:4.0%} of training: {status}", soft_wrap=True)

    def _success_rate(self) -> float:
        tries = sum(row["tries"] for row in self._recent)
        return sum(row["tries_reached"] for row in self._recent) / tries if tries else math.nan

    def _mean(self, key: str) -> float:
        values = [row[key] for row in self._recent if not math.isnan(row[key])]
        return sum(values) / len(values) if values else math.nan


def read_progress(path: Path) -> dict[str, list[float]]:
    """The columns of a table that :class:`ProgressLog` wrote; an interrupted last row is left out.

    Raises:
        FileNotFoundError: if there is none.
    """
    with path.open(newline="") as file:
        rows = [row for row in csv.DictReader(file) if None not in row.values()]
    return {key: [float(row[key]) for row in rows] for key in (rows[0] if rows else ())}
