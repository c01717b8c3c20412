"""Speed and accuracy of the Bullet physics presets.

Rovers execute the same commands for 5 s on flat ground, on a slope and on rough ground. The benchmark compares them
with a reference, Bullet at steps of 1 ms with all contacts: final difference in position and yaw, and mean difference
in roll and pitch. A second run of the reference, with the start moved by 1 mm, measures the sensitivity to the initial
state. Speed is that of a control step relative to Bullet with all contacts at 200 Hz, measured alternately in one run.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import Any

import torch
from rich.table import Table
from torch import Tensor

from benchmarks.options import Options
from benchmarks.ratios import paired
from benchmarks.told import told
from rover_rl.robots import get_robot
from rover_rl.rotations import quaternion_to_euler, wrap_angle
from rover_rl.sims.bullet import BulletSettings
from rover_rl.sims.bullet.settings import PRESETS
from rover_rl.sims.bullet.simulator import BulletSimulator
from rover_rl.worlds import Terrain, World, get_world

ALL_CONTACTS = BulletSettings(contact_threshold=math.inf)
REFERENCE = replace(ALL_CONTACTS, substeps=50)
SECONDS, STEPS_PER_SECOND = 5, 20
NUDGE = 0.001


def grounds() -> dict[str, World]:
    """Returns flat ground, a slope of 10 degrees, and the moon without its boulders."""
    x = torch.arange(161) * 0.25 - 20
    slope = Terrain((math.tan(math.radians(10)) * x).expand(161, -1), 0.25)
    return {
        "flat": World("flat", Terrain.flat((60, 60))),
        "slope": World("slope", slope),
        "rough": World("rough", get_world("moon").terrain),
    }


@dataclass(frozen=True)
class Trajectories:
    """Poses of rovers over time.

    Attributes:
        position: positions ``[T, N, 3]``, m.
        euler: roll, pitch and yaw ``[T, N, 3]``, rad.
    """

    position: Tensor
    euler: Tensor

    def difference(self, other: Trajectories) -> dict[str, float]:
        """Returns medians over the rovers: final position (m), final yaw (rad), and mean roll and pitch (rad)."""
        position = (self.position[-1, :, :2] - other.position[-1, :, :2]).norm(dim=-1)
        turned = wrap_angle(self.euler - other.euler).abs()
        return {
            "position_m": position.median().item(),
            "yaw_rad": turned[-1, :, 2].median().item(),
            "tilt_rad": turned[..., :2].mean((0, 2)).median().item(),
        }


def simulate(world: World, settings: BulletSettings, count: int, nudge: float = 0.0) -> Trajectories:
    """Simulates rovers for 5 s with random commands that change every second and do not depend on the settings.

    Args:
        world: world of the rovers.
        settings: settings of the physics.
        count: number of rovers.
        nudge: offset of the start in x, m.
    """
    random = torch.Generator().manual_seed(0)
    starts = torch.rand(count, 3, generator=random) * torch.tensor((16, 16, 2 * math.pi)) - torch.tensor((8, 8, 0))
    commands = torch.rand(SECONDS, count, 2, generator=random) * torch.tensor((1.6, 3.0)) - torch.tensor((0.6, 1.5))
    starts[:, 0] += nudge
    simulator = BulletSimulator([world] * count, get_robot("rover_zero"), 1, settings)
    simulator.reset(torch.ones(count, dtype=torch.bool), starts)
    states = [simulator.step(command) for command in commands for _ in range(STEPS_PER_SECOND)]
    simulator.close()
    return Trajectories(
        torch.stack([state.position for state in states]),
        torch.stack([quaternion_to_euler(state.orientation) for state in states]),
    )


def measure(options: Options) -> list[dict[str, Any]]:
    """Measures each ground with each preset. Returns a row for each."""
    rows = []
    for name, world in grounds().items():
        reference = simulate(world, REFERENCE, options.rovers)
        sensitivity = simulate(world, REFERENCE, options.rovers, NUDGE).difference(reference)
        rows.append({"ground": name, "physics": "1 ms, moved by 1 mm", "substeps": REFERENCE.substeps, **sensitivity})
        for physics, settings in {"all contacts": ALL_CONTACTS, **PRESETS}.items():
            ratio = told(f"{name}, {physics}", partial(_speed, world, settings, options))
            error = simulate(world, settings, options.rovers).difference(reference)
            rows.append({"ground": name, "physics": physics, "substeps": settings.substeps, **error, **ratio})
    return rows


def _speed(world: World, settings: BulletSettings, options: Options) -> dict[str, Any]:
    simulators = []
    for some in (settings, ALL_CONTACTS):
        simulator = BulletSimulator([world] * options.rovers, get_robot("rover_zero"), 1, some)
        starts = torch.rand(options.rovers, 3, generator=torch.Generator().manual_seed(0)) * 8 - 4
        simulator.reset(torch.ones(options.rovers, dtype=torch.bool), starts)
        simulators.append(simulator)
    command = torch.tensor((0.5, 0.5)).expand(options.rovers, 2)

    def stepping(simulator: BulletSimulator) -> int:
        simulator.step(command)
        return options.rovers

    one, other = simulators
    ratio = paired(lambda: stepping(one), lambda: stepping(other), options.seconds / 4, options.rounds)
    for simulator in simulators:
        simulator.close()
    return asdict(ratio)


def table(rows: list[dict[str, Any]]) -> Table:
    """Formats the rows for the terminal."""
    headings = ("ground", "physics", "substeps", "cm after 5 s", "yaw deg", "tilt deg", "speedup over all contacts")
    table = Table(*headings, title="Physics: difference from steps of 1 ms, and speed")
    for row in rows:
        table.add_row(
            row["ground"],
            row["physics"],
            str(row["substeps"]),
            f"{100 * row['position_m']:.2f}",
            f"{math.degrees(row['yaw_rad']):.2f}",
            f"{math.degrees(row['tilt_rad']):.3f}",
            f"{row['median']:.2f} ({row['least']:.2f} to {row['most']:.2f})" if "median" in row else "",
        )
    return table
