"""How many steps a second training takes in, beside Stable-Baselines3's on our Gymnasium class."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from rich.table import Table

from benchmarks import against_sb3
from benchmarks.options import Options


def measure(options: Options) -> list[dict[str, Any]]:
    """PPO and SAC: ours, SB3's with all rovers as one VecEnv, and with a process for each."""
    rows = []
    for algo in ("ppo", "sac"):
        for name, train in against_sb3.CONTENDERS.items():
            with TemporaryDirectory() as folder:
                settings = against_sb3.Options(
                    algo=algo, world=options.world, minutes=options.minutes, num_envs=options.rovers
                )
                last = train(settings.config(Path(folder)))[-1]
            rows.append({"algo": algo, "name": name, "steps_per_s": last.steps / (60 * last.minutes)})
    return rows


def table(rows: list[dict[str, Any]]) -> Table:
    """For the terminal."""
    table = Table("algorithm", "who", "steps/s", "ours beside it", title="Training, end to end")
    ours = {row["algo"]: row["steps_per_s"] for row in rows if row["name"] == "rover_rl"}
    for row in rows:
        ratio = ours[row["algo"]] / row["steps_per_s"]
        table.add_row(row["algo"].upper(), row["name"], f"{row['steps_per_s']:,.0f}", f"{ratio:.2f}")
    return table
