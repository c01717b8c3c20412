"""Worlds, episodes and recorded drives for tests, and what tests do with evaluations."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch
from rich.console import Console

from rover_rl import World
from rover_rl.algos.evaluation.episodes import EpisodeSet, draw_episodes
from rover_rl.algos.evaluation.evaluate import Evaluation
from rover_rl.algos.evaluation.trajectory import Trajectory
from rover_rl.envs.config import EnvConfig
from rover_rl.worlds import Terrain, box
from rover_rl.worlds.pool import WorldPool

WARP = EnvConfig(backend="warp")
FIELD = World("field", Terrain.flat((9.0, 9.0)))
WALL = World("wall", Terrain.flat((9.0, 9.0)), [box((0.0, 0.0, 0.5), (0.4, 4.0, 1.0))])
CRATES = World("crates", Terrain.flat((9.0, 9.0)), [box((2.0, y, 0.5), (0.5, 0.5, 1.0)) for y in (-2.0, 0.0, 2.0)])
POOL = WorldPool(FIELD, WALL, CRATES)
EPISODES = draw_episodes(POOL, 3, seed=1)  # three episodes in each of three worlds


def line(
    ending: str,
    start: tuple[float, float] = (0.0, 0.0),
    end: tuple[float, float] = (1.0, 0.0),
    steps: int = 20,
    reversals: float = math.nan,
) -> Trajectory:
    """A drive along a line at a constant speed."""
    share = torch.linspace(0, 1, steps + 1)[:, None]
    first, last = (torch.tensor([*point, 0.0]) for point in (start, end))
    none = torch.zeros(steps, dtype=torch.bool)
    return Trajectory(first + share * (last - first), torch.zeros(steps + 1, 3), none, none, ending, reversals)


def evaluation(name: str, endings: Sequence[str], episodes: EpisodeSet = EPISODES) -> Evaluation:
    """An evaluation of straight drives of 1 m, free of obstacles, with the given endings."""
    drives = [line(ending, (-3.0, -0.5), (-3.0, 0.5)) for ending in endings]
    return Evaluation(name, episodes.part(0, len(endings)).with_used_worlds(), 1, 60.0, drives)


def assert_same(ours: Sequence[Trajectory], theirs: Sequence[Trajectory]) -> None:
    """The same to the last bit."""
    for one, other in zip(ours, theirs, strict=True):
        assert (one.ending, one.dt) == (other.ending, other.dt)
        for key in ("position", "angles", "collision", "goal"):
            assert torch.equal(getattr(one, key), getattr(other, key))


def assert_alike(ours: Sequence[Trajectory], theirs: Sequence[Trajectory]) -> None:
    """The same to a millimeter."""
    for one, other in zip(ours, theirs, strict=True):
        torch.testing.assert_close(one.position, other.position, atol=1e-3, rtol=0)


def printed(show: Callable[..., None], content: Any, width: int = 160, **options: Any) -> str:
    """What a function prints to a console of a certain width."""
    console = Console(file=io.StringIO(), width=width)
    show(content, console, **options)
    return console.file.getvalue()  # type: ignore[attr-defined]


def csv_rows(path: Path) -> list[dict[str, str]]:
    with path.open() as file:
        return list(csv.DictReader(file))
