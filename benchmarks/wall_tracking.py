"""Accuracy of the tracker of long things that move, against where they are.

    python -m benchmarks.wall_tracking

Jackals drive to their goals with ``gridplanner``, and every scan is compared with the true boxes within 6 m on which at
least four readings end. One is told if a wall is parallel to it, within 0.15 m of one of its sides, and its velocity is
right within 0.25 m/s. A wall is false if there is no box within 0.5 m that is parallel to it.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from statistics import median

import torch
import tyro
from rich.console import Console
from rich.table import Table
from tensordict import TensorDictBase
from torch import Tensor

from rover_rl import RoverEnv
from rover_rl.algos.policy.dwa import LIDAR
from rover_rl.algos.policy.grid_planner import GridPlanner
from rover_rl.algos.policy.runner import PolicyRunner
from rover_rl.envs.config import EnvConfig, Randomization
from rover_rl.envs.scan_tracker import in_world
from rover_rl.envs.seen_map.scans import reading_directions
from rover_rl.envs.sensors.walls import MovingWalls, walls_of
from rover_rl.robots import get_robot
from rover_rl.sims.settings import CONTROL_DT

PERIOD, ROBOT = 2, "jackal"
"""Number of steps from one scan to the next, and robot."""
WITHIN, READINGS = 6.0, 4
"""Distance (m) up to which boxes count, and least number of readings on them."""
ASIDE, OFF, ALONE, OBLIQUE = 0.15, 0.25, 0.5, 0.25
"""Errors of the place (m) and of the velocity (m/s) of a wall that is right, distance from a box above which it is
false, m, and sine of its angle to a box that is parallel."""
SETTLED = 0.5
"""Time from the first reading of a box from which on it counts, s."""


@dataclass(frozen=True)
class Options:
    """Compare the tracker of long things that move with where they are."""

    worlds: tuple[str, ...] = (
        "gates:10000-10015@0.6",
        "gates:10000-10015@1",
        *(f"{kind}:10000-10015" for kind in ("maze", "rooms", "forest", "corridor", "moon")),
    )
    """Ranges of worlds."""
    noises: tuple[float, ...] = (0.0, 0.03)
    """Standard deviations of the ranges, m."""
    rows: int = 32
    """Number of rovers."""
    seconds: float = 20.0
    """Duration, s."""
    seed: int = 0
    """Seed of the rovers."""


class Truth:
    """Boxes of each row at a scan, ``[N, P]`` each: center, direction along, normal, velocity and half of the sides."""

    def __init__(self, env: RoverEnv) -> None:
        parts, course = env.movers.parts, env.movers.course
        assert parts is not None
        yaw = 2 * torch.atan2(parts.orientation[..., 2], parts.orientation[..., 3])
        self.center, self.half = parts.position[..., :2].clone(), parts.half[..., :2].clone()
        self.along = torch.stack((yaw.cos(), yaw.sin()), -1)
        self.normal = torch.stack((-yaw.sin(), yaw.cos()), -1)
        self.velocity = course.velocity.float().gather(1, parts.mover[..., None].expand(-1, -1, 2))
        self.is_box = parts.kind == 1

    def seen_from(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Returns points ``[N, K, 2]`` along each box and its normal, ``[N, P, K]`` each."""
        away = points[:, None] - self.center[:, :, None]
        return (away * self.along[:, :, None]).sum(-1), (away * self.normal[:, :, None]).sum(-1)


def compared(tensordict: TensorDictBase, truth: Truth, noise: float) -> tuple[Tensor, Tensor, Tensor]:
    """Returns which boxes are visible and which are told, ``[N, P]``, and which walls are near one, ``[N, 4]``."""
    place = tensordict["pose"][:, None, :2]
    ends = torch.tensor(get_robot(ROBOT).lidar_position[:2]) + tensordict["lidar"][..., None] * reading_directions(
        LIDAR
    )
    along, aside = truth.seen_from(place + in_world(ends, tensordict["imu"]))
    reach = truth.half[..., None, :] + 0.05 + 3 * noise
    on = (along.abs() < reach[..., 0]) & (aside.abs() < reach[..., 1]) & (tensordict["lidar"] < 11.9)[:, None]
    along, aside = (each[..., 0] for each in truth.seen_from(place))
    away = torch.stack(((along.abs() - truth.half[..., 0]).clamp(min=0), aside), -1).norm(dim=-1)
    visible = truth.is_box & (on.sum(-1) >= READINGS) & (away < WITHIN)
    walls = walls_of(tensordict["walls"])
    middle, direction, velocity = (in_world(walls[..., k : k + 2], tensordict["imu"]) for k in (0, 2, 5))
    along, aside = truth.seen_from(place + middle)
    parallel = (direction[:, None] * truth.normal[:, :, None]).sum(-1).abs() < OBLIQUE
    near = (walls[:, None, :, 4] > 0) & parallel & (along.abs() < truth.half[..., :1] + 0.3)
    side = (aside.abs() - truth.half[..., 1:]).abs()
    error = (velocity[:, None] - truth.velocity[:, :, None]).norm(dim=-1)
    return visible, (near & (side < ASIDE) & (error < OFF)).any(-1), (near & (side < ALONE)).any(1)


class Sightings:
    """Since when each box has been visible, and when it was told."""

    def __init__(self, truth: Truth) -> None:
        self.delays: list[float] = []
        self._before, shape = truth.center, truth.is_box.shape
        self._since, self._known = torch.full(shape, -1.0), torch.zeros(shape, dtype=torch.bool)

    def add(self, truth: Truth, visible: Tensor, told: Tensor) -> Tensor:
        """Adds a scan and returns which boxes count, bool ``[N, P]``. One that has begun again is another one."""
        begins = (truth.center - self._before).norm(dim=-1) > 1
        since = torch.where(begins | (self._since < 0), -1.0, self._since + PERIOD * CONTROL_DT)
        self._since = torch.where(visible & (since < 0), 0.0, since)
        known = self._known & ~begins
        self.delays += self._since[told & ~known & (self._since >= 0)].tolist()
        self._known, self._before = known | told, truth.center
        return visible & (self._since > SETTLED - 1e-3)


def drive(world: str, noise: float, options: Options) -> Iterator[tuple[TensorDictBase, Truth | None, Tensor]]:
    """Yields the observation, the boxes, and which rovers are still on their way, at each scan."""
    settings = {
        "num_envs": options.rows,
        "seed": options.seed,
        "backend": "warp",
        "robot": ROBOT,
        "lidar": replace(LIDAR, period=PERIOD),
    }
    settings |= {"sensors": (MovingWalls(period=PERIOD),), "randomization": Randomization(range_noise=noise)}
    env = RoverEnv(EnvConfig(world=world, end_on_goal=True, **settings))
    runner, tensordict = PolicyRunner(GridPlanner(ROBOT), env=env), env.reset()
    drives, moves = torch.ones(options.rows, dtype=torch.bool), env.movers.parts is not None
    for step in range(round(options.seconds / CONTROL_DT)):
        if step % PERIOD == 0:
            yield tensordict, Truth(env) if moves else None, drives
        tensordict = env.step(tensordict.set("action", runner(tensordict)))["next"]
        drives = drives & ~tensordict["done"].squeeze(-1)
    env.close()


def score(world: str, noise: float, options: Options) -> dict[str, float]:
    """Returns the share that is told, the median delay and the rate of false walls in a range of worlds."""
    total, sightings = Counter[str](), None
    for tensordict, truth, drives in drive(world, noise, options):
        false = (walls_of(tensordict["walls"])[..., 4] > 0) & drives[:, None]
        if truth is not None:
            visible, told, near = compared(tensordict, truth, noise)
            sightings = sightings or Sightings(truth)
            counts = sightings.add(truth, visible & drives[:, None], told)
            total["visible"] += int(counts.sum())
            total["told"] += int((counts & told).sum())
            false = false & ~near
        total["false"] += int(false.sum())
        total["scans"] += int(drives.sum())
    return {
        "told": 100 * total["told"] / total["visible"] if total["visible"] else math.nan,
        "delay": median(sightings.delays) if sightings and sightings.delays else math.nan,
        "false": 1000 * total["false"] / total["scans"],
    }


def main(options: Options) -> None:
    table = Table("world", "noise, m", "told, %", "told after, s", "false per 1,000 scans", title="Walls that move")
    for world in options.worlds:
        for noise in options.noises:
            found = score(world, noise, options)
            table.add_row(world, f"{noise:g}", *(f"{found[name]:.1f}" for name in ("told", "delay", "false")))
    Console(width=max(100, Console().width)).print(table)


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
