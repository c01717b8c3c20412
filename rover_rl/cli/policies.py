"""Policies as named on the command line, and options of the environment that they drive in."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from difflib import get_close_matches
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from rover_rl.algos.config_files import read_yaml
from rover_rl.algos.policy.names import BASELINES, PRETRAINED, is_baseline, load_policy, make_baseline
from rover_rl.envs.config import EnvConfig, GuardConfig, env_from_plain
from rover_rl.registry import perhaps
from rover_rl.robots.options import RobotOptions, with_options

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
_NAMES = f"pretrained:NAME, {', '.join(BASELINES)}, module:attribute or {RANDOM}"
ONE_POLICY = f"Folder of a run, checkpoint, ONNX file, .zip of Stable-Baselines3, {_NAMES}."
"""Help of an argument that names a policy."""
SEVERAL_POLICIES = f"Policies: run folders, checkpoints, ONNX files, .zip of Stable-Baselines3, {_NAMES}."
"""Help of an argument that names several policies."""
LIVE_POLICY = f"Policy: run folder, checkpoint, ONNX file, pretrained:NAME, module:attribute, {', '.join(BASELINES)}."
"""Help of an argument that names a policy for a live rover, which does not act at random."""
NO_POLICY = f"name a policy: the folder of a run, a checkpoint, {_NAMES}"
"""Error message if an argument that names several policies is missing."""


@dataclass(frozen=True)
class ResolvedPolicy:
    """A policy that an argument of the command line names."""

    name: str
    """Name of the policy in tables."""
    module: Policy | None
    """The policy; ``None`` acts at random."""
    worlds: tuple[str, ...]
    """Worlds to drive in; if empty, the policy drives in the worlds of the other policies."""
    folder: Path | None = None
    """Folder of the checkpoint; ``None`` if the policy has none."""
    config: TrainingConfig | None = None
    """Settings that the policy was trained with; ``None`` if it was not trained."""


def resolve_policies(words: Sequence[str], worlds: tuple[str, ...], robot: str | None = None) -> list[ResolvedPolicy]:
    """Resolves several words, each once. Policies of the same name are named by their words."""
    if not words:
        raise ValueError(NO_POLICY)
    policies = {word: resolve_policy(word, worlds, robot) for word in dict.fromkeys(words)}
    names = Counter(policy.name for policy in policies.values())
    return [policy if names[policy.name] == 1 else replace(policy, name=word) for word, policy in policies.items()]


def resolve_policy(word: str, worlds: tuple[str, ...], robot: str | None = None) -> ResolvedPolicy:
    """Resolves one word: see :data:`ONE_POLICY`. ``robot`` is that of a baseline.

    The policy drives in ``worlds``; if empty, in the ones that it was trained in, and for a range of seeds in one world
    that was not in the training.
    """
    if word == RANDOM:
        return ResolvedPolicy(word, None, worlds)
    if is_baseline(word):
        return ResolvedPolicy(word, make_baseline(word, robot), worlds)
    if word.endswith(ONNX):
        from rover_rl.algos.deploy.export import OnnxPolicy

        policy = OnnxPolicy(Path(word))
        return ResolvedPolicy(Path(word).stem, policy, worlds or _unseen(policy.config), config=policy.config)
    if word.endswith(SB3):
        from rover_rl.algos.policy.sb3_policy import SB3Policy

        return ResolvedPolicy(Path(word).stem, SB3Policy(Path(word)), worlds)
    checkpoint, name = load_checkpoint(word)
    config, folder = checkpoint.config, None if word.startswith(PRETRAINED) else _folder(word)
    return ResolvedPolicy(name, checkpoint.make_actor(), worlds or _unseen(config), folder, config)


def load_checkpoint(word: str) -> tuple[Checkpoint, str]:
    """Loads the checkpoint that a word of the command line names, and returns it with its name."""
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
    from rover_rl.names import unseen

    return tuple(map(unseen, config.env.world_names))


def _folder(word: str) -> Path:
    return Path(word) if Path(word).is_dir() else Path(word).parent


ROBOT_OPTIONS = tyro.conf.arg(name="robot")
"""The options of a robot have its prefix: ``--robot scout.urdf --robot.max-speed 2``."""
BACKEND = (
    "Simulator: bullet, warp, mujoco (an extra), or module:attribute. Default: that of --env, else bullet, or warp for "
    "several robots."
)
"""Help of an option that names the backend."""


@dataclass(frozen=True)
class EnvOptions:
    """Environment to drive in. Default: the one that the policy was made for, in Bullet, without randomization."""

    env: Path | None = None
    """YAML file of EnvConfig, or a run's config.yaml. Default: the policy's environment in Bullet, not randomized."""
    robot: str | None = None
    """Robot: a name, a URDF file, or module:attribute. Default: that of --env, else of the policy."""
    robot_options: Annotated[RobotOptions, ROBOT_OPTIONS] = field(default_factory=RobotOptions)
    """What a URDF does not tell of the robot."""
    physics: str | None = None
    """Preset of Bullet's physics: default, accurate or fast (docs/simulators.md#bullet-speed-and-accuracy)."""
    guard: GuardConfig = field(default_factory=GuardConfig)
    """Emergency brake. Default: that of --env."""
    compensate_delay: bool = False
    """Carry late pose, heading and velocities on to now (docs/randomization.md). Default: as --env says, else as in the
    training of the policy."""

    @property
    def given_robot(self) -> str | None:
        """The robot that is named, with its options."""
        return None if self.robot is None else with_options(self.robot, self.robot_options)

    def description(self, policy: Policy | None, backend: str | None) -> EnvConfig:
        """Returns the environment for a policy, in a backend."""
        from rover_rl.algos.evaluation.evaluate import default_backend, environment_for

        config = environment_for(policy, None if self.env is None else read_env(self.env))
        options = {"robot": self.robot, "backend": backend, "physics": self.physics}
        changes: dict[str, Any] = {key: given for key, given in options.items() if given}
        changes["robot_options"] = self.robot_options
        if self.env is None and backend is None:
            changes["backend"] = default_backend(self.robot or config.robot)
        if self.guard != GuardConfig():
            changes["guard"] = self.guard
        if self.compensate_delay:
            changes["compensate_delay"] = True
        return environment_for(policy, replace(config, **changes))


def read_env(path: Path) -> EnvConfig:
    """Reads fields of :class:`EnvConfig` from YAML, or from ``env`` in the settings of a training run."""
    data = read_yaml(path)
    if isinstance(data, dict) and isinstance(data.get("env"), dict):
        data = data["env"]
    return env_from_plain(data, str(path))
