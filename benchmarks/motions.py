"""Time that moving the movers takes, by motion.

    python -m benchmarks.motions --rows 4096 --movers 8

A row is a maze with movers of one motion, cylinders with a radius of 0.3 m. The table shows the median CPU time of one
step of all rows, on one thread, with the placement of the solids.
"""

from __future__ import annotations

import statistics
import time
from dataclasses import dataclass, replace

import torch
import tyro
from rich.console import Console
from rich.table import Table

from rover_rl.rng import row_keys
from rover_rl.sims.movers import MoverField
from rover_rl.worlds import get_world
from rover_rl.worlds.movers import Cross, Cylinder, Motion, Mover, Orca, Slider, SocialForce, Wander, Waypoints
from rover_rl.worlds.movers.motions.base import Others
from rover_rl.worlds.table import WorldTable

ROVER_RADIUS = 0.3
MOTIONS: tuple[Motion, ...] = (
    Waypoints([(0.0, -4.0, -4.0, 0.0), (3.0, -4.0, 4.0, 0.0), (6.0, 4.0, 4.0, 1.0)], random_start=True),
    Slider(to=(4.0, 0.0), phase=None),
    Wander(),
    Cross(),
    SocialForce(),
    Orca(),
)


@dataclass
class Settings:
    """Settings of the benchmark."""

    rows: int = 4096
    movers: int = 8
    steps: int = 30


def step_time(motion: Motion, settings: Settings) -> float:
    """Returns the median CPU time of a step, s."""
    rows = settings.rows
    maze = replace(get_world("maze"), movers=[Mover(motion, Cylinder(0.3))] * settings.movers)
    field = MoverField(WorldTable([maze] * rows), 0.05, ROVER_RADIUS)
    field.reset(torch.ones(rows, 1, dtype=torch.bool), row_keys(0, rows, torch.device("cpu")), torch.zeros(rows, 2))
    rovers = Others(torch.zeros(rows, 1, 2), torch.zeros(rows, 1, 2), ROVER_RADIUS)
    field.advance(None, rovers)
    times = []
    for _ in range(settings.steps):
        start = time.process_time()
        field.advance(None, rovers)
        times.append(time.process_time() - start)
    return statistics.median(times)


def main(settings: Settings) -> None:
    """Measures all motions."""
    torch.set_num_threads(1)
    table = Table("motion", "ms a step", "ns a mover", title=f"{settings.rows} rows with {settings.movers} movers each")
    for motion in MOTIONS:
        seconds = step_time(motion, settings)
        each = seconds / settings.rows / settings.movers * 1e9
        table.add_row(type(motion).__name__, f"{seconds * 1e3:.1f}", f"{each:.0f}")
    Console().print(table)


if __name__ == "__main__":
    main(tyro.cli(Settings))
