"""Agreement of the simulators with one another, and of Bullet with itself after a shift of the start by 1 mm.

Rovers receive the same commands in all simulators: on flat ground, a slope and rough ground, against a wall, down an
edge, over a ridge that touches the belly, and sideways off an edge. Reports for each pair of simulators the medians of
the differences in final position and yaw and of the mean differences in roll and pitch, and for each simulator the
share of rovers that roll over. Also compares the yaw rates of steady turns with Coulomb's law.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from itertools import combinations
from typing import Any

import torch
from rich.console import Group
from rich.table import Table
from torch import Tensor

from benchmarks import maneuvers
from benchmarks.coulomb import steady_motion
from benchmarks.engines import choose_engines
from benchmarks.law import center_of_mass
from benchmarks.maneuvers import Trajectories
from benchmarks.options import Options
from benchmarks.ratios import told
from rover_rl.robots import get_robot
from rover_rl.worlds import Terrain, World, box, get_world

ROLLOVER_ANGLE = math.radians(85)  # roll or pitch above which a rover counts as rolled over, rad
TURNS = ((0.0, 1.0), (0.0, 2.0), (0.5, 1.0))
"""Commands (m/s, rad/s) whose steady yaw rates are compared with Coulomb's law."""
BAR = 0.05  # largest median difference in position after 5 s that passes on flat ground, slope and rough ground, m
SECONDS = 5  # duration on flat ground, slope and rough ground, s
NUDGE = 0.001  # shift of the start, m
SENSITIVE = "bullet"  # simulator that is also compared with itself after a shift of the start


@dataclass(frozen=True)
class Scene:
    """World, start poses and commands of a comparison.

    ``starts`` are x, y (m) and yaw (rad), ``[N, 3]``. ``commands``, held for a second each, are forward speed (m/s) and
    yaw rate (rad/s), ``[seconds, N, 2]``. ``bar`` is the largest median difference in position that passes, m; ``None``
    where small differences grow large.
    """

    world: World
    starts: Tensor
    commands: Tensor
    bar: float | None = None

    def simulate(self, engine: Any, nudge: float = 0.0) -> Trajectories:
        """Simulates the scene, with starts shifted by ``nudge`` (m) along x."""
        starts = self.starts + torch.tensor((nudge, 0.0, 0.0))
        commands = [(command, 1.0) for command in self.commands]
        return maneuvers.drive(engine, [self.world] * len(starts), starts, commands)


def scenes(count: int) -> dict[str, Scene]:
    random = torch.Generator().manual_seed(0)

    def uniform(low: tuple[float, ...], high: tuple[float, ...]) -> Tensor:
        width = torch.tensor(high) - torch.tensor(low)
        return torch.tensor(low) + width * torch.rand(count, len(low), generator=random)

    anywhere = uniform((-8, -8, -math.pi), (8, 8, math.pi))
    changing = torch.stack([uniform((-0.6, -1.5), (1.0, 1.5)) for _ in range(SECONDS)])
    at_walls = uniform((-0.2, -3.0, -0.9), (0.2, 3.0, 0.9))
    forward = uniform((0.3, -0.3), (1.0, 0.3)).expand(3, -1, -1)
    ahead = uniform((-0.2, -3.0, -0.3), (0.2, 3.0, 0.3))
    sideways = uniform((-0.2, -3.0, 1.2), (0.2, 3.0, 1.9))
    found = {name: Scene(world, anywhere, changing, BAR) for name, world in grounds().items()}
    wall = World("wall", Terrain.flat((40, 40)), [box((1.2, 0.0, 0.5), (0.4, 12.0, 1.0))])
    return found | {
        "against a wall": Scene(wall, at_walls, forward),
        "down an edge of 0.2 m": Scene(_stepped(-0.2), ahead, forward),
        "over a ridge that touches the belly": Scene(_ridge(0.16), ahead, forward),
        "sideways off an edge": Scene(_stepped(-0.8), sideways - torch.tensor((-0.55, 0.0, 0.0)), forward),
    }


def grounds() -> dict[str, World]:
    """Flat ground, a slope of 10 degrees, and the moon without its boulders."""
    x = torch.arange(161) * 0.25 - 20
    slope = Terrain((math.tan(math.radians(10)) * x).expand(161, -1), 0.25)
    return {
        "flat": World("flat", Terrain.flat((60, 60))),
        "slope": World("slope", slope),
        "rough": World("rough", get_world("moon").terrain),
    }


def _stepped(rise: float) -> World:
    """Flat ground that rises between x = 0.5 and 0.75 m."""
    heights = torch.zeros(161, 161)
    heights[:, 83:] = rise
    return World("edge", Terrain(heights, 0.25))


def _ridge(height: float) -> World:
    """Flat ground with a triangular ridge, 0.5 m wide, across the path."""
    heights = torch.zeros(161, 161)
    heights[:, 84] = height
    return World("ridge", Terrain(heights, 0.25))


def rolled_over(trajectories: Trajectories) -> float:
    """Share of the rovers that roll over."""
    return (trajectories.euler[..., :2].abs() > ROLLOVER_ANGLE).any(0).any(-1).float().mean().item()


def measure(options: Options) -> dict[str, Any]:
    """Measures the scenes and the steady turns in every simulator of the options."""
    engines = choose_engines(options.engines)
    return {
        "scenes": [
            told(f"scene {name}", partial(_compare, name, scene, engines))
            for name, scene in scenes(options.rovers).items()
        ],
        "turns": [told(f"turn {command}", partial(_steady_turn, *command, engines)) for command in TURNS],
    }


def _compare(name: str, scene: Scene, engines: list[str]) -> dict[str, Any]:
    """Differences of each pair of simulators in a scene, and the share of rovers that roll over in each simulator."""
    driven = {engine: scene.simulate(engine) for engine in engines}
    pairs = {}
    if SENSITIVE in driven:
        nudged = scene.simulate(SENSITIVE, NUDGE)
        pairs[f"{SENSITIVE}, shifted by 1 mm"] = nudged.difference(driven[SENSITIVE])
    for one, other in combinations(engines, 2):
        pairs[f"{one} and {other}"] = driven[other].difference(driven[one])
    shares = {engine: rolled_over(trajectories) for engine, trajectories in driven.items()}
    return {"scene": name, "bar_m": scene.bar, "pairs": pairs, "rolled_over": shares}


def _steady_turn(linear: float, angular: float, engines: list[str]) -> dict[str, Any]:
    """Yaw rate under a constant command: by Coulomb's law, and the mean over 16 headings in each simulator."""
    law = steady_motion(get_robot("rover_zero"), center_of_mass()[0], linear, angular).yaw
    rates = {
        engine: maneuvers.turning_rate(engine, maneuvers.PLANE, linear, angular).mean().item() for engine in engines
    }
    return {"command": f"{linear} m/s, {angular} rad/s", "coulomb": law, "engines": rates}


def table(found: dict[str, Any]) -> Group:
    pairs, engines = list(found["scenes"][0]["pairs"]), list(found["turns"][0]["engines"])
    differences = Table(
        "scene",
        *pairs,
        title="Median differences: final position (cm), final yaw and tilt (degrees)",
        caption=f"* more than {100 * BAR:g} cm on flat ground, slope or rough ground.",
    )
    rollovers = Table("scene", *engines, title="Share of rovers that roll over")
    for row in found["scenes"]:
        differences.add_row(row["scene"], *(_cell(row["pairs"][pair], row["bar_m"]) for pair in pairs))
        rollovers.add_row(row["scene"], *(f"{row['rolled_over'][engine]:.0%}" for engine in engines))
    turns = Table("command", "Coulomb's law", *engines, title="Yaw rate on level ground, rad/s")
    for row in found["turns"]:
        rates = (row["coulomb"], *(row["engines"][engine] for engine in engines))
        turns.add_row(row["command"], *(f"{rate:.3f}" for rate in rates))
    return Group(differences, rollovers, turns)


def _cell(difference: dict[str, float], bar: float | None) -> str:
    yaw, tilt = (math.degrees(difference[key]) for key in ("yaw_rad", "tilt_rad"))
    text = f"{100 * difference['position_m']:.1f}, {yaw:.1f}, {tilt:.2f}"
    return f"[red]{text} *[/red]" if bar is not None and difference["position_m"] > bar else text
