"""Policies by the words that name them on the command line."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rover_rl.algos.config import TrainingConfig
    from rover_rl.algos.evaluation.evaluate import Policy
    from rover_rl.algos.policy.checkpoint import Checkpoint

PRETRAINED = "pretrained:"
"""What comes before the name of a policy of the package."""
ONNX = ".onnx"
"""What the name of an exported policy ends with."""


@dataclass(frozen=True)
class ResolvedPolicy:
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


def resolve_policy(word: str, worlds: tuple[str, ...]) -> ResolvedPolicy:
    """The policy that a word on the command line means.

    Raises:
        FileNotFoundError: if it names no checkpoint.
        ValueError: if it names something else.
    """
    from rover_rl.algos.policy.baselines import ScriptedPolicy

    if word == "random":
        return ResolvedPolicy(word, None, worlds)
    if word == "scripted":
        return ResolvedPolicy(word, ScriptedPolicy(), worlds)
    if word.endswith(ONNX):
        from rover_rl.algos.deploy.export import OnnxPolicy

        policy = OnnxPolicy(Path(word))
        trained_in = worlds or policy.config.worlds
        return ResolvedPolicy(Path(word).stem, policy, trained_in, policy.lidar_points, config=policy.config)
    checkpoint, name = load_checkpoint(word)
    return ResolvedPolicy(
        name=name,
        policy=checkpoint.make_actor(),
        worlds=worlds or checkpoint.config.worlds,
        lidar_points=checkpoint.lidar_points,
        folder=None if word.startswith(PRETRAINED) else _folder(word),
        config=checkpoint.config,
    )


def load_checkpoint(word: str) -> tuple[Checkpoint, str]:
    """The checkpoint that a word on the command line means, and what to call it.

    Raises:
        FileNotFoundError: if there is none.
        ValueError: if it is something else.
    """
    from rover_rl.algos.policy.checkpoint import Checkpoint
    from rover_rl.algos.pretrained import load_pretrained

    if word.startswith(PRETRAINED):
        name = word.removeprefix(PRETRAINED)
        return load_pretrained(name), name
    return Checkpoint.load(word), _folder(word).resolve().name


def _folder(word: str) -> Path:
    return Path(word) if Path(word).is_dir() else Path(word).parent
