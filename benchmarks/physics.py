"""What physics costs, and how far it is from the truth.

Rovers drive the same commands for 5 s on flat ground, on a slope and on rough ground, and are compared with Bullet at
steps of 1 ms and with all contacts: how far apart they end, in position and yaw, and how far roll and pitch are apart
in the mean. The reference beside itself, its start moved by 1 mm, tells how much of that is chance. Speed is that of a
control step of the simulator beside one with Bullet's own contacts at 200 Hz, in turn in one run.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, replace
from typing import Any

import torch
from rich.table import Table
from torch import Tensor

from benchmarks.options import Options
from benchmarks.ratios import paired
from rover_rl.sims.bullet import BulletSettings
from rover_rl.sims.bullet.settings import PRESETS
from rover_rl.sims.bullet.simulator import BulletSimulator
from rover_rl.sims.robots import get_robot
from rover_rl.sims.rotations import quaternion_to_euler, wrap_angle
from rover_rl.sims.worlds import Terrain, World, get_world

ALL_CONTACTS = BulletSettings(contact_threshold=math.inf)
REFERENCE = replace(ALL_CONTACTS, substeps=50)
SECONDS, STEPS_PER_SECOND = 5, 20
NUDGE = 0.001


def grounds() -> dict[str, World]:
    """Flat, a slope of 10 degrees, and the moon without its boulders."""
    x = torch.arange(161) * 0.25 - 20
    slope = Terrain((math.tan(math.radians(10)) * x).expand(161, -1), 0.25)
    return {
        "flat": World("flat", Terrain.flat((60, 60))),
        "slope": World("slope", slope),
        "rough": World("rough", get_world("moon").terrain),
    }


@dataclass(frozen=True)
class Drive:
    """Where rovers went: position ``[T, N, 3]`` and roll, pitch, yaw ``[T, N, 3]``."""

    position: Tensor
    euler: Tensor

    def distance(self, other: Drive) -> dict[str, float]:
        """Medians over the rovers: of positions (m) and yaw (rad) in the end, and of mean roll and pitch (rad)."""
        position = (self.position[-1, :, :2] - other.position[-1, :, :2]).norm(dim=-1)
        turned = wrap_angle(self.euler - other.euler).abs()
        return {
            "position_m": position.median().item(),
            "yaw_rad": turned[-1, :, 2].median().item(),
            "tilt_rad": turned[..., :2].mean((0, 2)).median().item(),
        }


def driven(world: World, settings: BulletSettings, count: int, nudge: float = 0.0) -> Drive:
    """The same drives whatever the settings: five seconds, with another command each second."""
    random = torch.Generator().manual_seed(0)
    starts = torch.rand(count, 3, generator=random) * torch.tensor((16, 16, 2 * math.pi)) - torch.tensor((8, 8, 0))
    commands = torch.rand(SECONDS, count, 2, generator=random) * torch.tensor((1.6, 3.0)) - torch.tensor((0.6, 1.5))
    starts[:, 0] += nudge
    simulator = BulletSimulator([world] * count, get_robot("rover_zero"), 1, settings)
    simulator.reset(torch.ones(count, dtype=torch.bool), starts)
    states = [simulator.step(command) for command in commands for _ in range(STEPS_PER_SECOND)]
    simulator.close()
    return Drive(
        torch.stack([state.position for state in states]),
        torch.stack([quaternion_to_euler(state.orientation) for state in states]),
    )


def measure(options: Options) -> list[dict[str, Any]]:
    """A row for each ground and settings."""
    rows = []
    for name, world in grounds().items():
        reference = driven(world, REFERENCE, options.rovers)
        chance = driven(world, REFERENCE, options.rovers, NUDGE).distance(reference)
        rows.append({"ground": name, "physics": "1 ms, moved by 1 mm", "substeps": REFERENCE.substeps, **chance})
        for physics, settings in {"all contacts": ALL_CONTACTS, **PRESETS}.items():
            ratio = _speed(world, settings, options)
            error = driven(world, settings, options.rovers).distance(reference)
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
    """For the terminal."""
    headings = (
        "ground",
        "physics",
        "substeps",
        "cm after 5 s",
        "yaw deg",
        "tilt deg",
        "times as fast as with all contacts",
    )
    table = Table(*headings, title="Physics: distance from steps of 1 ms, and speed")
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
