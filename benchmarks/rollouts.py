"""How fast batched rollouts are, and how much of the time Bullet takes.

Steps are those of ``step_and_maybe_reset`` with the contract's reward under random actions. Times are medians over the
steps in which nothing was reset: inside Bullet's ``stepSimulation`` and ``rayTestBatch``, and all else (read-out and
motor calls, task, rewards, TorchRL).
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from typing import Any

from rich.table import Table
from torchrl.envs import EnvBase

from benchmarks.collecting import make_worker_env, rollouts
from benchmarks.options import Options
from benchmarks.ratios import rate
from rover_rl.sims.native.bullet import pybullet

WARM_UP = 3
"""Steps that do not count."""


@dataclass(frozen=True)
class Row:
    """Figures of one environment; times in microseconds.

    Attributes:
        num_envs: rovers.
        beams: of each.
        steps_per_s: of one process.
        all_workers: steps per second of all processes together, where they can share the rovers.
        physics: inside ``stepSimulation``, per rover.
        rays: inside ``rayTestBatch``, per rover.
        rest: all else, per batched step.
    """

    num_envs: int
    beams: int
    steps_per_s: float
    all_workers: float | None
    physics: float
    rays: float
    rest: float

    @property
    def share(self) -> float:
        """Of a step, what is not inside Bullet."""
        return self.rest / (self.rest + self.num_envs * (self.physics + self.rays))


class Stopwatch:
    """Adds up the time inside one function of PyBullet."""

    def __init__(self, function: Callable[..., Any]) -> None:
        self.seconds = 0.0
        self._function = function

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        start = time.perf_counter()
        result = self._function(*args, **kwargs)
        self.seconds += time.perf_counter() - start
        return result

    def take(self) -> float:
        """The time since the last call, in seconds."""
        seconds, self.seconds = self.seconds, 0.0
        return seconds


@contextmanager
def watched(*names: str) -> Iterator[list[Stopwatch]]:
    """Stopwatches in the place of functions of PyBullet."""
    functions = {name: getattr(pybullet, name) for name in names}
    watches = [Stopwatch(function) for function in functions.values()]
    try:
        for name, watch in zip(names, watches, strict=True):
            setattr(pybullet, name, watch)
        yield watches
    finally:
        for name, function in functions.items():
            setattr(pybullet, name, function)


def rolled_out(env: EnvBase, seconds: float) -> dict[str, float]:
    """Drives with random actions for about ``seconds``, and tells where the time went."""
    count = env.batch_size[0]
    actions = [env.action_spec.rand() for _ in range(16)]
    td = env.reset()
    times: list[tuple[float, float, float]] = []
    total = steps = 0.0
    with watched("stepSimulation", "rayTestBatch") as watches:
        begin, number = time.perf_counter(), 0
        while time.perf_counter() - begin < seconds or len(times) < 5:
            td.set("action", actions[number % 16])
            for watch in watches:
                watch.take()
            start = time.perf_counter()
            result, td = env.step_and_maybe_reset(td)
            passed = time.perf_counter() - start
            physics, rays = (watch.take() for watch in watches)
            number += 1
            if number <= WARM_UP:
                continue
            steps, total = steps + count, total + passed
            if not result["next", "done"].any() or number > 500:
                times.append((physics / count, rays / count, passed - physics - rays))
    physics, rays, rest = (statistics.median(column) * 1e6 for column in zip(*times, strict=True))
    return {"steps_per_s": steps / total, "physics": physics, "rays": rays, "rest": rest}


def measure(options: Options) -> list[dict[str, Any]]:
    """A row for each number of beams and of rovers."""
    rows = []
    for beams in options.beams:
        for num_envs in options.num_envs:
            env = make_worker_env(options.world, num_envs, beams, 0)
            figures = rolled_out(env, options.seconds)
            env.close()
            shared = None
            if options.workers > 1 and num_envs % options.workers == 0:
                with rollouts(options.world, num_envs, beams, options.workers) as batch:
                    batch()
                    shared = rate(batch, options.seconds)
            rows.append(asdict(Row(num_envs=num_envs, beams=beams, all_workers=shared, **figures)))
    return rows


def table(rows: list[dict[str, Any]]) -> Table:
    """For the terminal."""
    headings = "rovers", "beams", "steps/s", "all workers", "us/rover: physics", "rays", "us/batch: rest", "share"
    table = Table(*headings, title="Batched rollouts")
    for row in (Row(**row) for row in rows):
        table.add_row(
            f"{row.num_envs:,}",
            str(row.beams),
            f"{row.steps_per_s:,.0f}",
            "" if row.all_workers is None else f"{row.all_workers:,.0f}",
            f"{row.physics:,.0f}",
            f"{row.rays:,.0f}",
            f"{row.rest:,.0f}",
            f"{row.share:.1%}",
        )
    return table
