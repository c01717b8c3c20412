"""How far Warp is from Bullet, and Bullet from itself when a start is moved by 1 mm.

Rovers drive the same commands in both on flat ground, a slope and rough ground, at a wall, down an edge, over a ridge
that catches their belly, and over the side. Told are medians of how far apart they end, in position and yaw, of how
much roll and pitch differ on the way, and the share of rovers that fall over in each. What the laws alone say of a spin
on the spot is beside what both simulators make of it.
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
from benchmarks.physics import NUDGE, SECONDS, STEPS_PER_SECOND, Drive, grounds
from rover_rl.sims import Backend, make_simulator
from rover_rl.sims.bullet import BulletSettings
from rover_rl.sims.robots import get_robot
from rover_rl.sims.rotations import quaternion_to_euler
from rover_rl.sims.warp import WarpSettings
from rover_rl.sims.warp.inertial_model import read_figures
from rover_rl.sims.worlds import Terrain, World, box

FALLEN = math.radians(85)
"""Roll or pitch from which on a rover has fallen over."""
SPINS = ((0.0, 1.0), (0.0, 2.0), (0.5, 1.0))
"""Commands whose steady motion is compared with Coulomb's law."""


@dataclass(frozen=True)
class Scene:
    """Where rovers start, and what each is told in each second.

    Attributes:
        world: where.
        starts: x, y (m) and yaw (rad), ``[N, 3]``.
        commands: forward speed (m/s) and yaw rate (rad/s), ``[seconds, N, 2]``.
    """

    world: World
    starts: Tensor
    commands: Tensor

    def driven(self, settings: Backend, nudge: float = 0.0) -> Drive:
        """Where the rovers go."""
        count = len(self.starts)
        robot = get_robot("rover_zero")
        simulator = make_simulator(settings, worlds=[self.world] * count, robot=robot, lidar_beams=1)
        simulator.reset(torch.ones(count, dtype=torch.bool), self.starts + torch.tensor((nudge, 0.0, 0.0)))
        states = [simulator.step(command) for command in self.commands for _ in range(STEPS_PER_SECOND)]
        simulator.close()
        return Drive(
            torch.stack([state.position for state in states]),
            torch.stack([quaternion_to_euler(state.orientation) for state in states]),
        )


def scenes(count: int) -> dict[str, Scene]:
    """The scenes, of ``count`` rovers each."""
    random = torch.Generator().manual_seed(0)

    def uniform(low: tuple[float, ...], high: tuple[float, ...]) -> Tensor:
        return torch.tensor(low) + (torch.tensor(high) - torch.tensor(low)) * torch.rand(
            count, len(low), generator=random
        )

    anywhere = uniform((-8, -8, -math.pi), (8, 8, math.pi))
    changing = torch.stack([uniform((-0.6, -1.5), (1.0, 1.5)) for _ in range(SECONDS)])
    at_walls = uniform((-0.2, -3.0, -0.9), (0.2, 3.0, 0.9))
    onwards = uniform((0.3, -0.3), (1.0, 0.3)).expand(3, -1, -1)
    ahead = uniform((-0.2, -3.0, -0.3), (0.2, 3.0, 0.3))
    sideways = uniform((-0.2, -3.0, 1.2), (0.2, 3.0, 1.9))
    found = {name: Scene(world, anywhere, changing) for name, world in grounds().items()}
    wall = World("wall", Terrain.flat((40, 40)), [box((1.2, 0.0, 0.5), (0.4, 12.0, 1.0))])
    return found | {
        "at a wall": Scene(wall, at_walls, onwards),
        "down an edge of 0.2 m": Scene(_stepped(-0.2), ahead, onwards),
        "over a ridge that catches the belly": Scene(_ridge(0.16), ahead, onwards),
        "over the side": Scene(_stepped(-0.8), sideways - torch.tensor((-0.55, 0.0, 0.0)), onwards),
    }


def _stepped(rise: float) -> World:
    """Flat ground that rises between x = 0.5 and 0.75 m."""
    heights = torch.zeros(161, 161)
    heights[:, 83:] = rise
    return World("edge", Terrain(heights, 0.25))


def _ridge(height: float) -> World:
    """A roof of 0.5 m across the way."""
    heights = torch.zeros(161, 161)
    heights[:, 84] = height
    return World("ridge", Terrain(heights, 0.25))


def fallen(drive: Drive) -> float:
    """Share of the rovers that fall over."""
    return (drive.euler[..., :2].abs() > FALLEN).any(0).any(-1).float().mean().item()


def measure(options: Options) -> dict[str, Any]:
    """Rows of scenes, and of spins."""
    rows = []
    for name, scene in scenes(options.rovers).items():
        bullet = scene.driven(BulletSettings())
        nudged, warp = scene.driven(BulletSettings(), NUDGE), scene.driven(WarpSettings())
        for pair, drive in (("Bullet, moved by 1 mm", nudged), ("Warp", warp)):
            row = {"scene": name, "pair": pair, **drive.distance(bullet)}
            rows.append(row | {"fallen": fallen(drive), "fallen_in_bullet": fallen(bullet)})
    return {"scenes": rows, "spins": [_spin(*command) for command in SPINS]}


def _spin(linear: float, angular: float) -> dict[str, Any]:
    """The yaw rate of a command held, by Coulomb's law and as the mean over 16 headings in each simulator."""
    robot = get_robot("rover_zero")
    figures = read_figures(robot)
    center = figures.total(torch.tensor([figures.chassis_mass], dtype=torch.float64))[1][0, 0].item()
    turned = torch.arange(16) * (2 * math.pi / 16)
    starts = torch.stack((torch.zeros(16), torch.zeros(16), turned), -1)
    command = torch.tensor((linear, angular)).expand(3, 16, 2)
    scene = Scene(World("flat", Terrain.flat((60, 60))), starts, command)
    row = {"command": f"{linear} m/s, {angular} rad/s", "coulomb": steady_motion(robot, center, linear, angular).yaw}
    for name, settings in (("bullet", BulletSettings()), ("warp", WarpSettings())):
        yaw = scene.driven(settings).euler[-STEPS_PER_SECOND - 1 :, :, 2]
        steps = torch.remainder(yaw[1:] - yaw[:-1] + math.pi, 2 * math.pi) - math.pi
        row[name] = steps.sum(0).mean().item()
    return row


def table(found: dict[str, Any]) -> Group:
    """For the terminal."""
    headings = "scene", "beside Bullet", "cm in the end", "yaw deg", "tilt deg", "fallen", "in Bullet"
    apart = Table(*headings, title="Warp beside Bullet: medians")
    for row in found["scenes"]:
        apart.add_row(
            row["scene"],
            row["pair"],
            f"{100 * row['position_m']:.1f}",
            f"{math.degrees(row['yaw_rad']):.1f}",
            f"{math.degrees(row['tilt_rad']):.2f}",
            f"{row['fallen']:.0%}",
            f"{row['fallen_in_bullet']:.0%}",
        )
    spins = Table("command", "Coulomb's law", "Warp", "Bullet", title="Yaw rate on level ground, rad/s")
    for row in found["spins"]:
        spins.add_row(row["command"], *(f"{row[name]:.3f}" for name in ("coulomb", "warp", "bullet")))
    return Group(apart, spins)
