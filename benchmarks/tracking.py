"""Accuracy of the tracker of movers, against where they are.

    python -m benchmarks.tracking

Rovers drive towards their goals, at different speeds and with random turns. Every scan is compared with the true movers
within 6 m that are faster than 0.35 m/s. One is visible if at least two readings end on it, and tracked if a moving
track is within 0.4 m of it. A moving track without a mover within 0.6 m is false.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import torch
import tyro
from rich.console import Console
from rich.table import Table
from tensordict import TensorDictBase
from torch import Tensor

from rover_rl import RoverEnv
from rover_rl.algos.policy.dwa import LIDAR
from rover_rl.envs.config import EnvConfig
from rover_rl.envs.mover_tracker import STATE, TRACKS, MoverTracker
from rover_rl.envs.seen_map.scans import reading_directions
from rover_rl.robots import get_robot
from rover_rl.sims.settings import CONTROL_DT

WITHIN, MOVING = 6.0, 0.35
"""Distance (m) up to which movers count, and speed (m/s) from which on they do."""
NEAR, APART = 0.4, 0.6
"""Distance of a track from a mover below which it is tracked, and above which the track is false, m."""
SETTLED = 1.0
"""Time from the start of an episode that does not count, s."""


@dataclass(frozen=True)
class Options:
    """Compare the tracker of movers with where they are."""

    worlds: tuple[str, ...] = tuple(
        f"{kind}:200-215@{difficulty}"
        for kind in ("field", "plaza", "corridor", "crossing")
        for difficulty in ("0.3", "0.9")
    )
    """Ranges of worlds."""
    periods: tuple[int, ...] = (2, 4)
    """Numbers of steps of 0.05 s from one scan to the next."""
    rows: int = 32
    """Number of rovers."""
    seconds: float = 20.0
    """Duration, s."""
    seed: int = 0
    """Seed of the rovers."""


class Truth(NamedTuple):
    """Movers at a scan: position ``[N, M, 2]``, velocity, radius ``[N, M]``, and which exist."""

    position: Tensor
    velocity: Tensor
    radius: Tensor
    exists: Tensor


def drive(world: str, options: Options) -> Iterator[tuple[TensorDictBase, Truth, Tensor]]:
    """Yields the observation, the movers, and which rovers are still on their way, at each step."""
    settings = {"num_envs": options.rows, "seed": options.seed, "backend": "warp", "lidar": LIDAR, "end_on_goal": True}
    env = RoverEnv(EnvConfig(world=world, **settings))
    random = torch.Generator().manual_seed(options.seed)
    speed, td = 0.4 + 0.6 * torch.rand(options.rows, 1, generator=random), env.reset()
    drives = torch.ones(options.rows, dtype=torch.bool)
    for step in range(round(options.seconds / env.control_dt)):
        course = env.movers.course
        where = course.position.float(), course.velocity.float(), env.movers.radius.float(), env.movers.present
        yield td, Truth(*(value.clone() for value in where)), drives
        if step % 20 == 0:
            aside = 0.8 * torch.randn(options.rows, 1, generator=random)
        angle = (td["target"][:, 1:] + aside).clamp(-1.5, 1.5)
        td = env.step(td.set("action", torch.cat((speed, angle), -1)))["next"]
        drives = drives & ~td["done"].squeeze(-1)
    env.close()


def score(world: str, period: int, options: Options) -> dict[str, float]:
    """Returns shares and errors in a range of worlds, with a scan every ``period`` steps."""
    total, state = Counter[str](), torch.zeros(options.rows, TRACKS * STATE)
    tracker = MoverTracker(get_robot("rover_zero"), LIDAR, CONTROL_DT * period)
    for step, (td, truth, drives) in enumerate(drive(world, options)):
        if step % period:
            continue
        state, tracks = tracker(state, td["lidar"], td["pose"], td["imu"])
        if CONTROL_DT * step < SETTLED:
            continue
        apart = (truth.position[:, :, None] - tracks.position[:, None]).norm(dim=-1)
        nearest, track = apart.masked_fill(~tracks.moves[:, None], torch.inf).min(-1)
        away = (truth.position - td["pose"][:, None, :2]).norm(dim=-1)
        counts = truth.exists & (away < WITHIN) & (truth.velocity.norm(dim=-1) > MOVING) & drives[:, None]
        visible, tracked = counts & _visible(td, truth), nearest < NEAR
        seen = visible & tracked
        error = (tracks.velocity.gather(1, track[..., None].expand(-1, -1, 2)) - truth.velocity).norm(dim=-1)
        lonely = apart.masked_fill(~truth.exists[..., None], torch.inf).amin(1) > APART
        total["all"] += int(counts.sum())
        total["all tracked"] += int((counts & tracked).sum())
        total["visible"] += int(visible.sum())
        total["tracked"] += int(seen.sum())
        total["position"] += float(nearest[seen].sum())
        total["wrong velocity"] += int((error[seen] > 0.5).sum())
        total["false"] += int((tracks.moves & lonely & drives[:, None]).sum())
        total["scans"] += int(drives.sum())
    return {
        "visible": 100 * total["tracked"] / total["visible"],
        "all": 100 * total["all tracked"] / total["all"],
        "position": total["position"] / total["tracked"],
        "velocity": 100 * total["wrong velocity"] / total["tracked"],
        "false": total["false"] / total["scans"],
    }


def _visible(td: TensorDictBase, truth: Truth) -> Tensor:
    """Returns on which movers at least two readings end, bool ``[N, M]``."""
    yaw, lidar = td["imu"][:, 2:], td["lidar"]
    ahead, left = (lidar[..., None] * reading_directions(LIDAR)).unbind(-1)
    ends = torch.stack((yaw.cos() * ahead - yaw.sin() * left, yaw.sin() * ahead + yaw.cos() * left), -1)
    ends = td["pose"][:, None, :2] + ends
    apart = (ends[:, None] - truth.position[:, :, None]).norm(dim=-1)
    return ((apart < truth.radius[..., None] + 0.05) & (lidar < LIDAR.max_range)[:, None]).sum(-1) >= 2


def main(options: Options) -> None:
    columns = "world", "scans/s", "visible, %", "all, %", "position, m", "velocity > 0.5 m/s off, %", "false per scan"
    table = Table(*columns, title="Movers that are tracked, and how well")
    for world in options.worlds:
        for period in options.periods:
            found = score(world, period, options)
            numbers = (f"{found[name]:.1f}" for name in ("visible", "all"))
            others = f"{found['position']:.3f}", f"{found['velocity']:.1f}", f"{found['false']:.2f}"
            table.add_row(world, f"{20 / period:g}", *numbers, *others)
    Console(width=max(120, Console().width)).print(table)


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
