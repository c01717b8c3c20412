"""``rover-rl train``."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from rover_rl.algos.config import CONFIGS, PPOConfig, SACConfig, TrainingConfig, read_config, run_config
from rover_rl.cli.policies import PRETRAINED

if TYPE_CHECKING:
    from rover_rl.algos.train.run import TrainingSummary

INTERRUPTED = 130
"""Exit code after Ctrl-C."""


@dataclass(frozen=True)
class Train:
    """Train a policy with PPO or SAC; the settings below are those of the algorithm that --algo names.

    Writes config.yaml, progress.csv, checkpoint.pt, snapshots and a learning curve to a new folder. Ctrl-C ends it with
    a checkpoint; --resume goes on.
    """

    config: tyro.conf.OmitArgPrefixes[TrainingConfig]
    algo: Literal["ppo", "sac"] = "ppo"
    """Learning algorithm. See its settings with --algo sac --help."""
    config_file: Annotated[Path | None, tyro.conf.arg(name="config")] = None
    """Take the settings from this YAML file, such as a run's config.yaml, or those that a policy of the package was
    trained with, as in pretrained:maze-ppo; options given beside it go first."""
    resume: Path | None = None
    """Go on with the run in this folder, with its settings; options given beside it go first."""

    def __call__(self) -> int:
        """Trains, and says where the policy is."""
        # Before PyTorch is imported, which takes seconds.
        self.config.check()
        from rover_rl.algos.evaluation.plots import draw_learning_curve

        summary = train(self.config, self.resume)
        print(format_summary(summary), flush=True)
        draw_learning_curve([summary.folder], summary.folder / "learning_curve.png")
        print(f"Try it: rover-rl evaluate {summary.checkpoint}")
        return INTERRUPTED if summary.interrupted else 0


@dataclass(frozen=True)
class TrainPPO(Train):  # noqa: D101, it has the docstring of Train
    __doc__ = Train.__doc__
    config: tyro.conf.OmitArgPrefixes[PPOConfig]


@dataclass(frozen=True)
class TrainSAC(Train):  # noqa: D101, it has the docstring of Train
    __doc__ = Train.__doc__
    config: tyro.conf.OmitArgPrefixes[SACConfig]


def train_defaults(args: Sequence[str]) -> Train:
    """The command before its options are read: its algorithm, and settings from a file if one is named.

    Args:
        args: of the command line, the command's name first.

    Raises:
        FileNotFoundError: if there is no such file or run.
        ValueError: if its settings cannot be read, or belong to another algorithm.
    """
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    for option in ("--algo", "--config", "--resume"):
        parser.add_argument(option, nargs="?")
    named = parser.parse_known_args(args[1:])[0] if args[:1] == ["train"] else argparse.Namespace()
    algo, file, resume = (getattr(named, name, None) for name in ("algo", "config", "resume"))
    if file is not None and resume is not None:
        raise ValueError("--config begins a new run, and --resume goes on with one: give one of them")
    if file is not None:
        config = _settings(file)
    else:
        config = run_config(resume) if resume else CONFIGS.get(algo or "ppo", PPOConfig)()
    if algo in CONFIGS and algo != config.algo:
        raise ValueError(f"the settings are those of {config.algo}, and --algo is {algo}")
    kind = TrainPPO if isinstance(config, PPOConfig) else TrainSAC
    return kind(config, algo=config.algo)  # type: ignore[arg-type]


def _settings(source: str) -> TrainingConfig:
    """From a YAML file, or those of a policy of the package."""
    if not source.startswith(PRETRAINED):
        return read_config(source)
    from rover_rl.algos.pretrained import load_pretrained

    config = load_pretrained(source.removeprefix(PRETRAINED)).config
    return replace(config, runs=TrainingConfig.runs, name=None)


def train(config: TrainingConfig, folder: Path | None = None) -> TrainingSummary:
    """Trains with the algorithm that the settings belong to; see :func:`train_ppo` and :func:`train_sac`."""
    if isinstance(config, PPOConfig):
        from rover_rl.algos.train.ppo import train_ppo

        return train_ppo(config, folder)
    assert isinstance(config, SACConfig)
    from rover_rl.algos.train.sac import train_sac

    return train_sac(config, folder)


def format_summary(summary: TrainingSummary) -> str:
    """What a training came to, and where its time went."""
    stopped = "Interrupted" if summary.interrupted else "Trained"
    shares = ", ".join(f"{name} {share:.0%}" for name, share in summary.shares.items())
    return (
        f"{stopped} after {summary.steps:,} steps in {summary.minutes:.1f} minutes: {summary.checkpoint}\n"
        f"Time went into: {shares}"
    )
