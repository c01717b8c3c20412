"""Policies, by the words that name them on the command line."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rover_rl.algos.config import TrainingConfig
    from rover_rl.algos.evaluation.evaluate import Policy
    from rover_rl.algos.policy.checkpoint import Checkpoint

PRETRAINED = "pretrained:"
"""Prefix of the name of a policy of the package."""
ONNX = ".onnx"
"""Suffix of an exported policy."""


@dataclass(frozen=True)
class ResolvedPolicy:
    """A policy to drive with.

    Attributes:
        name: name in tables.
        module: the policy; ``None`` acts at random.
        worlds: worlds to drive in; none: those of the other policies.
        folder: folder of its checkpoint.
        config: settings that it was trained with.
    """

    name: str
    module: Policy | None
    worlds: tuple[str, ...]
    folder: Path | None = None
    config: TrainingConfig | None = None


def resolve_policy(word: str, worlds: tuple[str, ...], robot: str | None = None) -> ResolvedPolicy:
    """The policy that a word on the command line names.

    Args:
        word: ``random``, ``scripted``, ``pretrained:NAME``, or the path of a run's folder, checkpoint or ONNX file.
        worlds: worlds to drive in; none: the ones that the policy was trained in.
        robot: robot of the scripted policy; ``None``: the default one.

    Raises:
        FileNotFoundError: if there is no checkpoint.
        ValueError: if the word names something else.
    """
    from rover_rl.algos.policy.baselines import ScriptedPolicy

    if word == "random":
        return ResolvedPolicy(word, None, worlds)
    if word == "scripted":
        return ResolvedPolicy(word, ScriptedPolicy(robot) if robot else ScriptedPolicy(), worlds)
    if word.endswith(ONNX):
        from rover_rl.algos.deploy.export import OnnxPolicy

        policy = OnnxPolicy(Path(word))
        return ResolvedPolicy(Path(word).stem, policy, worlds or policy.config.env.world_names, config=policy.config)
    checkpoint, name = load_checkpoint(word)
    return ResolvedPolicy(
        name=name,
        module=checkpoint.make_actor(),
        worlds=worlds or checkpoint.env.world_names,
        folder=None if word.startswith(PRETRAINED) else _folder(word),
        config=checkpoint.config,
    )


def load_checkpoint(word: str) -> tuple[Checkpoint, str]:
    """The checkpoint that a word on the command line names, and its name.

    Raises:
        FileNotFoundError: if there is none.
        ValueError: if the word names something else.
    """
    from rover_rl.algos.policy.checkpoint import Checkpoint
    from rover_rl.algos.pretrained import load_pretrained

    if word.startswith(PRETRAINED):
        name = word.removeprefix(PRETRAINED)
        return load_pretrained(name), name
    return Checkpoint.load(word), _folder(word).resolve().name


def _folder(word: str) -> Path:
    return Path(word) if Path(word).is_dir() else Path(word).parent
