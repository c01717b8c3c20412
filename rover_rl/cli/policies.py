"""Policies as named on the command line."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from difflib import get_close_matches
from pathlib import Path
from typing import TYPE_CHECKING

from rover_rl.algos.policy.names import BASELINES, PRETRAINED, load_policy, make_baseline
from rover_rl.registry import perhaps

if TYPE_CHECKING:
    from rover_rl.algos.config import TrainingConfig
    from rover_rl.algos.evaluation.evaluate import Policy
    from rover_rl.algos.policy.checkpoint import Checkpoint

ONNX = ".onnx"
"""Suffix of exported ONNX policies."""
LOG = ".jsonl"
"""Suffix of the logs of ``rover-rl drive``."""
SB3 = ".zip"
"""Suffix of policies that Stable-Baselines3 saved."""
RANDOM = "random"
"""Name of the policy that acts at random."""
_NAMES = f"pretrained:NAME, {', '.join(BASELINES)} or {RANDOM}"
ONE_POLICY = f"Folder of a run, checkpoint, ONNX file, .zip of Stable-Baselines3, {_NAMES}."
"""Help of an argument that names a policy."""
SEVERAL_POLICIES = f"Policies: run folders, checkpoints, ONNX files, .zip of Stable-Baselines3, {_NAMES}."
"""Help of an argument that names several policies."""
LIVE_POLICY = (
    f"Policy: folder of a run, checkpoint file, ONNX file, pretrained:NAME, or a baseline: {', '.join(BASELINES)}."
)
"""Help of an argument that names a policy for a live rover, which does not act at random."""
NO_POLICY = f"name a policy: the folder of a run, a checkpoint, {_NAMES}"
"""Error message if an argument that names several policies is missing."""


@dataclass(frozen=True)
class ResolvedPolicy:
    """A policy that an argument of the command line names.

    Attributes:
        name: name of the policy in tables.
        module: the policy; ``None`` acts at random.
        worlds: worlds to drive in; if empty, the policy drives in the worlds of the other policies.
        folder: folder of the checkpoint; ``None`` if the policy has none.
        config: settings that the policy was trained with; ``None`` if it was not trained.
    """

    name: str
    module: Policy | None
    worlds: tuple[str, ...]
    folder: Path | None = None
    config: TrainingConfig | None = None


def resolve_policies(words: Sequence[str], worlds: tuple[str, ...], robot: str | None = None) -> list[ResolvedPolicy]:
    """Resolves several words, each once. Policies of the same name are named by their words."""
    if not words:
        raise ValueError(NO_POLICY)
    policies = {word: resolve_policy(word, worlds, robot) for word in dict.fromkeys(words)}
    names = Counter(policy.name for policy in policies.values())
    return [policy if names[policy.name] == 1 else replace(policy, name=word) for word, policy in policies.items()]


def resolve_policy(word: str, worlds: tuple[str, ...], robot: str | None = None) -> ResolvedPolicy:
    """Resolves the name of a policy on the command line.

    Args:
        word: ``random``, name of a baseline (:data:`rover_rl.algos.policy.names.BASELINES`), ``pretrained:NAME``, or
            the path of a run's folder, checkpoint, ONNX file or file of Stable-Baselines3.
        worlds: worlds to drive in; if empty, the ones that the policy was trained in. For a range of seeds, it is one
            world that was not in the training.
        robot: robot of a baseline; ``None``: the default robot.
    """
    if word == RANDOM:
        return ResolvedPolicy(word, None, worlds)
    if word in BASELINES:
        return ResolvedPolicy(word, make_baseline(word, robot), worlds)
    if word.endswith(ONNX):
        from rover_rl.algos.deploy.export import OnnxPolicy

        policy = OnnxPolicy(Path(word))
        return ResolvedPolicy(Path(word).stem, policy, worlds or _unseen(policy.config), config=policy.config)
    if word.endswith(SB3):
        from rover_rl.algos.policy.sb3_policy import SB3Policy

        return ResolvedPolicy(Path(word).stem, SB3Policy(Path(word)), worlds)
    checkpoint, name = load_checkpoint(word)
    return ResolvedPolicy(
        name=name,
        module=checkpoint.make_actor(),
        worlds=worlds or _unseen(checkpoint.config),
        folder=None if word.startswith(PRETRAINED) else _folder(word),
        config=checkpoint.config,
    )


def load_checkpoint(word: str) -> tuple[Checkpoint, str]:
    """Loads the checkpoint that an argument of the command line names, and returns it with its name."""
    from rover_rl.algos.pretrained import pretrained_names

    if word.startswith(PRETRAINED):
        return load_policy(word), word.removeprefix(PRETRAINED)
    if not Path(word).exists():
        # The name of a pretrained policy, with a typing error or without its prefix.
        names = get_close_matches(word.rpartition(":")[2], pretrained_names(), n=1)
        similar = f", perhaps {PRETRAINED + names[0]!r}" if names else perhaps(word, [*BASELINES, RANDOM])
        raise FileNotFoundError(f"no checkpoint at {word}{similar}")
    return load_policy(word), _folder(word).resolve().name


def _unseen(config: TrainingConfig) -> tuple[str, ...]:
    """Returns the worlds of the training, or for a range one that was not in it."""
    from rover_rl.sims.worlds.names import unseen

    return tuple(map(unseen, config.env.world_names))


def _folder(word: str) -> Path:
    return Path(word) if Path(word).is_dir() else Path(word).parent
