"""How training goes: what is counted in each batch, the table on disk and the progress bar."""

from __future__ import annotations

import csv
import math
import time
from pathlib import Path
from types import TracebackType

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn
from tensordict import TensorDictBase

EPISODE_STEPS = 2000
"""Steps of a full episode, as the contract has it."""
_RECENT = 10
"""Batches that the progress bar looks back over."""


class BatchStatistics:
    """Counts what happened in batches of decisions that follow one another.

    The success rate of training is the share of the episodes that ended in which at least one goal was reached, as
    ``episodes_reached / episodes``. It is measured with exploration, and with the time limit of training.

    Attributes:
        steps: taken so far, all rovers together.
    """

    def __init__(self) -> None:
        self.steps = 0

    def __call__(self, batch: TensorDictBase) -> dict[str, float]:
        """Statistics of the next batch ``[N, T]``, rewards unscaled; nan where there is nothing to count."""
        after = batch["next"]
        outcome, ended = after["outcome"], after["done"]
        before, self.steps = self.steps, int(outcome["total_steps"][:, -1].sum())
        goals = int(outcome["goals"].sum())
        return {
            "steps": self.steps,
            "goals_per_2000_steps": goals * EPISODE_STEPS / max(self.steps - before, 1),
            "episodes": int(ended.sum()),
            "episodes_reached": int((after["episode_goal_reward"][ended] > 0).sum()),
            "episode_steps": outcome["steps"][ended].float().mean().item(),
            "episode_return": after["episode_reward"][ended].mean().item(),
        }


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
        episodes = sum(row["episodes"] for row in self._recent)
        return sum(row["episodes_reached"] for row in self._recent) / episodes if episodes else math.nan

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
