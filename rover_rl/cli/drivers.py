"""Policies by the words that name them on the command line."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rover_rl.algos.config import TrainingConfig
    from rover_rl.algos.evaluate import Policy

PRETRAINED = "pretrained:"
"""What comes before the name of a policy of the package."""


@dataclass(frozen=True)
class Driver:
    """A policy to evaluate.

    Attributes:
        name: in tables.
        policy: itself; ``None`` acts at random.
        worlds: to drive in; none: all that others drive in.
        lidar_points: readings that it sees.
        folder: of its checkpoint.
        config: it was trained with.
    """

    name: str
    policy: Policy | None
    worlds: tuple[str, ...]
    lidar_points: int = 32
    folder: Path | None = None
    config: TrainingConfig | None = None


def find_driver(word: str, worlds: tuple[str, ...]) -> Driver:
    """The policy that a word on the command line means.

    Raises:
        FileNotFoundError: if it names no checkpoint.
        ValueError: if it names something else.
    """
    from rover_rl.algos.baselines import ScriptedPolicy
    from rover_rl.algos.runs import Checkpoint

    if word == "random":
        return Driver(word, None, worlds)
    if word == "scripted":
        return Driver(word, ScriptedPolicy(), worlds)
    folder = None
    if word.startswith(PRETRAINED):
        from rover_rl.algos.pretrained import load_pretrained

        name = word.removeprefix(PRETRAINED)
        checkpoint = load_pretrained(name)
    else:
        checkpoint = Checkpoint.load(word)
        folder = Path(word) if Path(word).is_dir() else Path(word).parent
        name = folder.resolve().name
    trained_in = checkpoint.config.world
    return Driver(
        name=name,
        policy=checkpoint.make_actor(),
        worlds=worlds or (trained_in,),
        lidar_points=checkpoint.lidar_points,
        folder=folder,
        config=checkpoint.config,
    )
