"""Steps per second of training, compared with Stable-Baselines3."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from rich.table import Table

from benchmarks import against_sb3
from benchmarks.options import Options
from benchmarks.told import told


def measure(options: Options) -> list[dict[str, Any]]:
    """Trains PPO and SAC with each of :data:`against_sb3.CONTENDERS`. Returns a row for each."""
    rows = []
    for algo in ("ppo", "sac"):
        for name, train in against_sb3.CONTENDERS.items():
            with TemporaryDirectory() as folder:
                settings = against_sb3.Options(
                    algo=algo, world=options.world, minutes=options.minutes, num_envs=options.rovers
                )
                last = told(f"{algo.upper()}, {name}", partial(train, settings.config(Path(folder))))[-1]
            rows.append({"algo": algo, "name": name, "steps_per_s": last.steps / (60 * last.minutes)})
    return rows


def table(rows: list[dict[str, Any]]) -> Table:
    """Formats the rows for the terminal."""
    table = Table("algorithm", "training", "steps/s", "speedup of rover_rl", title="Training, end to end")
    ours = {row["algo"]: row["steps_per_s"] for row in rows if row["name"] == "rover_rl"}
    for row in rows:
        ratio = ours[row["algo"]] / row["steps_per_s"]
        table.add_row(row["algo"].upper(), row["name"], f"{row['steps_per_s']:,.0f}", f"{ratio:.2f}")
    return table
