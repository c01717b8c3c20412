"""Agreement of Warp with Bullet, and of Bullet with itself after a shift of the start by 1 mm.

Rovers receive the same commands in both simulators: on flat ground, a slope and rough ground, against a wall, down an
edge, over a ridge that touches the belly, and sideways off an edge. Reports medians of the differences in final
position and yaw and of the mean differences in roll and pitch, and the share of rovers that roll over. Also compares
the yaw rates of steady turns with Coulomb's law.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import torch
from rich.console import Group
from rich.table import Table
from torch import Tensor

from benchmarks.coulomb import steady_motion
from benchmarks.options import Options
from benchmarks.physics import NUDGE, SECONDS, STEPS_PER_SECOND, Trajectories, grounds
from rover_rl.sims import Backend, make_simulator
from rover_rl.sims.bullet import BulletSettings
from rover_rl.sims.robots import get_robot
from rover_rl.sims.robots.inertial_model import read_inertial_model
from rover_rl.sims.rotations import quaternion_to_euler
from rover_rl.sims.warp import WarpSettings
from rover_rl.sims.worlds import Terrain, World, box

ROLLOVER_ANGLE = math.radians(85)
"""Roll or pitch above which a rover counts as rolled over, rad."""
TURNS = ((0.0, 1.0), (0.0, 2.0), (0.5, 1.0))
"""Commands (m/s, rad/s) whose steady yaw rates are compared with Coulomb's law."""


@dataclass(frozen=True)
class Scene:
    """World, start poses and commands of a comparison.

    Attributes:
        world: world of all rovers.
        starts: start poses: x, y (m) and yaw (rad), ``[N, 3]``.
        commands: commands, held for a second each: forward speed (m/s) and yaw rate (rad/s), ``[seconds, N, 2]``.
    """

    world: World
    starts: Tensor
    commands: Tensor

    def simulate(self, settings: Backend, nudge: float = 0.0) -> Trajectories:
        """Simulates the scene, with starts shifted by ``nudge`` (m) along x, and returns the trajectories."""
        count = len(self.starts)
        robot = get_robot("rover_zero")
        simulator = make_simulator(settings, worlds=[self.world] * count, robot=robot, lidar_beams=1)
        simulator.reset(torch.ones(count, dtype=torch.bool), self.starts + torch.tensor((nudge, 0.0, 0.0)))
        states = [simulator.step(command) for command in self.commands for _ in range(STEPS_PER_SECOND)]
        simulator.close()
        return Trajectories(
            torch.stack([state.position for state in states]),
            torch.stack([quaternion_to_euler(state.orientation) for state in states]),
        )


def scenes(count: int) -> dict[str, Scene]:
    """Builds all scenes, with ``count`` rovers each."""
    random = torch.Generator().manual_seed(0)

    def uniform(low: tuple[float, ...], high: tuple[float, ...]) -> Tensor:
        return torch.tensor(low) + (torch.tensor(high) - torch.tensor(low)) * torch.rand(
            count, len(low), generator=random
        )

    anywhere = uniform((-8, -8, -math.pi), (8, 8, math.pi))
    changing = torch.stack([uniform((-0.6, -1.5), (1.0, 1.5)) for _ in range(SECONDS)])
    at_walls = uniform((-0.2, -3.0, -0.9), (0.2, 3.0, 0.9))
    forward = uniform((0.3, -0.3), (1.0, 0.3)).expand(3, -1, -1)
    ahead = uniform((-0.2, -3.0, -0.3), (0.2, 3.0, 0.3))
    sideways = uniform((-0.2, -3.0, 1.2), (0.2, 3.0, 1.9))
    found = {name: Scene(world, anywhere, changing) for name, world in grounds().items()}
    wall = World("wall", Terrain.flat((40, 40)), [box((1.2, 0.0, 0.5), (0.4, 12.0, 1.0))])
    return found | {
        "against a wall": Scene(wall, at_walls, forward),
        "down an edge of 0.2 m": Scene(_stepped(-0.2), ahead, forward),
        "over a ridge that touches the belly": Scene(_ridge(0.16), ahead, forward),
        "sideways off an edge": Scene(_stepped(-0.8), sideways - torch.tensor((-0.55, 0.0, 0.0)), forward),
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
    """Measures the scenes and the steady turns."""
    rows = []
    for name, scene in scenes(options.rovers).items():
        bullet = scene.simulate(BulletSettings())
        nudged, warp = scene.simulate(BulletSettings(), NUDGE), scene.simulate(WarpSettings())
        for pair, trajectories in (("Bullet, start shifted by 1 mm", nudged), ("Warp", warp)):
            row = {"scene": name, "pair": pair, **trajectories.difference(bullet)}
            rows.append(row | {"rolled_over": rolled_over(trajectories), "rolled_over_in_bullet": rolled_over(bullet)})
    return {"scenes": rows, "spins": [_steady_turn(*command) for command in TURNS]}


def _steady_turn(linear: float, angular: float) -> dict[str, Any]:
    """Yaw rate under a constant command: by Coulomb's law, and the mean over 16 headings in each simulator."""
    robot = get_robot("rover_zero")
    model = read_inertial_model(robot)
    center = model.total(torch.tensor([model.chassis_mass], dtype=torch.float64))[1][0, 0].item()
    headings = torch.arange(16) * (2 * math.pi / 16)
    starts = torch.stack((torch.zeros(16), torch.zeros(16), headings), -1)
    command = torch.tensor((linear, angular)).expand(3, 16, 2)
    scene = Scene(World("flat", Terrain.flat((60, 60))), starts, command)
    row = {"command": f"{linear} m/s, {angular} rad/s", "coulomb": steady_motion(robot, center, linear, angular).yaw}
    for name, settings in (("bullet", BulletSettings()), ("warp", WarpSettings())):
        yaw = scene.simulate(settings).euler[-STEPS_PER_SECOND - 1 :, :, 2]
        steps = torch.remainder(yaw[1:] - yaw[:-1] + math.pi, 2 * math.pi) - math.pi
        row[name] = steps.sum(0).mean().item()
    return row


def table(found: dict[str, Any]) -> Group:
    """Formats the results as tables for the terminal."""
    headings = "scene", "compared with Bullet", "position, cm", "yaw, deg", "tilt, deg", "rolled over", "in Bullet"
    scenes_table = Table(*headings, title="Differences from Bullet: medians")
    for row in found["scenes"]:
        scenes_table.add_row(
            row["scene"],
            row["pair"],
            f"{100 * row['position_m']:.1f}",
            f"{math.degrees(row['yaw_rad']):.1f}",
            f"{math.degrees(row['tilt_rad']):.2f}",
            f"{row['rolled_over']:.0%}",
            f"{row['rolled_over_in_bullet']:.0%}",
        )
    turns = Table("command", "Coulomb's law", "Warp", "Bullet", title="Yaw rate on level ground, rad/s")
    for row in found["spins"]:
        turns.add_row(row["command"], *(f"{row[name]:.3f}" for name in ("coulomb", "warp", "bullet")))
    return Group(scenes_table, turns)
