"""The command ``rover-rl train``."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from rover_rl.algos.config import (
    ALGORITHMS,
    PARTS,
    AlgorithmConfig,
    CollectionConfig,
    NetworkConfig,
    PPOConfig,
    RunConfig,
    TrainingConfig,
    default_config,
    task_config,
    with_settings,
)
from rover_rl.algos.config_files import SEED_SUFFIX, read_config, run_config
from rover_rl.algos.policy.names import PRETRAINED, load_policy
from rover_rl.cli.help_text import FLAT
from rover_rl.cli.options import Host, Port
from rover_rl.cli.training_page import TrainingPage
from rover_rl.envs.config import EnvConfig
from rover_rl.envs.imperfections import imperfect
from rover_rl.sims.backends import name_of

if TYPE_CHECKING:
    from rover_rl.algos.train.run import TrainingSummary

FAILED = 2  # exit code after an error, such as an invalid option or a missing file
INTERRUPTED = 130  # exit code after Ctrl-C


@dataclass(frozen=True)
class RunOptions(RunConfig):
    """Settings of the run, with the policy that it starts from as --from."""

    task_name: tyro.conf.Suppress[str | None] = None
    started_from: Annotated[str | None, tyro.conf.arg(name="from")] = None
    """Policy to train further, in a new run: pretrained:NAME, folder of a run, or checkpoint. Other options override
    the settings of its training (docs/training.md#fine-tuning)."""


@dataclass(frozen=True)
class Train:
    """Train a policy with PPO or SAC. The options below are those of the selected algorithm.

    Writes config.yaml, progress.csv, checkpoint.pt, snapshots and a learning curve to a new folder. Ctrl-C saves a
    checkpoint and ends the run; --resume continues it.
    """

    task: Annotated[tyro.conf.Positional[str | None], tyro.conf.arg(metavar="TASK")] = None
    """Task to learn: a name (rover-rl tasks lists them), or module:attribute. Its settings are the defaults of all
    options. Name it first."""
    learner: str | None = None
    """Learner of the task whose settings are the defaults, such as ppo, ppo-gru or sac. Default: the task's first."""
    algo: Literal["ppo", "sac"] = "ppo"
    """Learning algorithm. --algo sac --help shows the options of SAC."""
    config_file: Annotated[Path | None, tyro.conf.arg(name="config")] = None
    """YAML file of settings, such as a run's config.yaml, or pretrained:NAME. Other options override its settings.
    After a task, a file changes some of its settings."""
    resume: Path | None = None
    """Folder of a run to continue. Options may change its length, learning rate, what it saves and what computes."""
    seeds: tuple[int, ...] = ()
    """Train once for each seed, one run after another, in folders NAME-seed0 and so on, for rover-rl compare.
    The same command continues runs that were interrupted."""
    randomize: tuple[str, ...] | None = None
    """Train with imperfections of real rovers: of a typical one, or harsh ones with --randomize harsh, or one of late,
    jumps, odometry, noise, all (docs/randomization.md). The options of --randomization, --pose and --limits override
    them."""
    view: bool = False
    """Open a page with the learning curve and some of the rovers that learn (needs the extra view)."""
    host: Host = "127.0.0.1"
    port: Port = 8080
    run: Annotated[RunOptions, FLAT] = field(default_factory=RunOptions)
    env: Annotated[EnvConfig, FLAT] = field(default_factory=EnvConfig)
    network: Annotated[NetworkConfig, FLAT] = field(default_factory=NetworkConfig)
    collection: Annotated[CollectionConfig, FLAT] = field(default_factory=CollectionConfig)
    algorithm: Annotated[AlgorithmConfig, FLAT] = field(default_factory=PPOConfig)
    first_word: tyro.conf.Suppress[str | None] = None
    """Task whose settings are the defaults, which the command line named first."""
    backend_settings: tyro.conf.Suppress[Any] = None
    """Settings of the backend that a file provides. The command line has no options for them."""

    @property
    def config(self) -> TrainingConfig:
        """Settings of the training run."""
        env = self.env
        if self.backend_settings is not None and env.backend == name_of(self.backend_settings):
            env = replace(env, backend=self.backend_settings)
        return TrainingConfig(env, self.network, self.collection, self.algorithm, RunConfig(**vars(self.run)))

    def __call__(self) -> int:
        config = self.config
        if self.task is not None:
            raise ValueError(f"name the task before the options: rover-rl train {self.task} ...")
        # Checks the settings before importing PyTorch, which takes seconds.
        config.check()
        if self.seeds and self.resume is not None:
            raise ValueError("--resume continues one run; several --seeds are continued by the command that began them")
        with ExitStack() as stack:
            page = None
            if self.view:
                page = stack.enter_context(TrainingPage(self.host, self.port))
                print(f"Page: {page.address}, in some seconds", flush=True)
            if self.seeds:
                return self._train_seeds(config, page)
            of_task = f"{self.run.task_name} " if self.run.task_name else ""
            return train_one(config, self.resume, f"To evaluate it: rover-rl evaluate {of_task}{{}}", page)

    def _train_seeds(self, config: TrainingConfig, page: TrainingPage | None) -> int:
        """Trains a policy for each seed. A run that diverges does not keep the others from being trained."""
        from rover_rl.algos.experiments.runs import seed_runs

        runs = seed_runs(config, self.seeds)
        failed = 0
        for number, (run, folder) in enumerate(runs, 1):
            print(f"Run {number} of {len(runs)}, seed {run.seed}:", flush=True)
            try:
                code = train_one(run, folder, page=page)
            except FloatingPointError as error:
                print(f"rover-rl: {error}", file=sys.stderr)
                code, failed = 0, FAILED
            if code:
                print(f"Run {number} of {len(runs)} was interrupted. The same command continues it and those after it.")
                return code
        names = [str(Path(run.run.runs, run.run.name or "")) for run, _ in runs]
        together = names[0].removesuffix(f"{SEED_SUFFIX}{runs[0][0].seed}")
        print(f"To evaluate them: rover-rl evaluate {' '.join(names)}")
        print(f"To compare them with others: rover-rl compare {together}")
        return failed


def train_one(
    config: TrainingConfig, folder: Path | None, advice: str | None = None, page: TrainingPage | None = None
) -> int:
    """Trains a policy, or continues the run in ``folder``, draws its learning curve and prints a summary."""
    from rover_rl.algos.experiments.curves import draw_learning_curve
    from rover_rl.algos.train import train

    summary = train(config, folder, begun=None if page is None else page.show)
    print(format_summary(summary), flush=True)
    draw_learning_curve([summary.folder], summary.folder / "learning_curve.png")
    if advice:
        print(advice.format(summary.checkpoint))
    return INTERRUPTED if summary.interrupted else 0


def train_defaults(args: Sequence[str]) -> Train:
    """Returns the command with the defaults of its options: those of the algorithm, of a file or of a run."""
    given = _early_options(args)
    task = args[1] if args[:1] == ["train"] and len(args) > 1 and not args[1].startswith("-") else None
    starts = (task or given.config, given.resume, given.source)
    if sum(start is not None for start in starts) > 1 or (task and (given.config or "").startswith(PRETRAINED)):
        text = "a task, which a file of --config may change, --config and --from start a new run"
        raise ValueError(f"{text}, and --resume continues one: give one of them")
    if given.learner is not None and task is None:
        raise ValueError("--learner is one of those of a task: rover-rl train TASK --learner NAME")
    config = _starting_settings(given) if task is None else task_config(task, given.learner)
    if task is not None and given.config is not None:
        config = read_config(given.config, config)
    if given.algo in ALGORITHMS and given.algo != config.algo:
        raise ValueError(f"the settings are those of {config.algo}, and --algo is {given.algo}")
    if given.randomize is not None:
        if len(given.randomize) > 1:
            raise ValueError(f"--randomize takes one name, got {' '.join(given.randomize)}")
        config = replace(config, env=imperfect(config.env, (given.randomize or ["typical"])[0]))
    parts = {part: getattr(config, part) for part in PARTS} | {"run": RunOptions(**vars(config.run))}
    settings = None if isinstance(config.env.backend, str) else config.env.backend
    if settings is not None:
        parts["env"] = replace(config.env, backend=name_of(settings))
    # tyro makes options of the fields that the default has: those of the algorithm.
    named = {"first_word": task, "learner": given.learner}
    return Train(algo=config.algo, backend_settings=settings, **named, **parts)  # type: ignore[arg-type]


def _early_options(args: Sequence[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    for option in ("--algo", "--learner", "--config", "--resume", "--backend", "--total-steps"):
        parser.add_argument(option, nargs="?")
    parser.add_argument("--from", dest="source", nargs="?")
    parser.add_argument("--world", nargs="*")
    parser.add_argument("--randomize", nargs="*")
    return parser.parse_known_args(args[1:] if args[:1] == ["train"] else [])[0]


def _starting_settings(given: argparse.Namespace) -> TrainingConfig:
    if given.config is not None and given.config.startswith(PRETRAINED):
        return with_settings(load_policy(given.config).config, runs=RunConfig.runs, name=None)
    if given.config is not None:
        return read_config(given.config)
    if given.resume is not None:
        return run_config(given.resume)
    if given.source is not None:
        from rover_rl.algos.train.fine_tuning import fine_tuning_config

        steering: dict[str, Any] = {"world": tuple(given.world)} if given.world else {}
        return fine_tuning_config(given.source, **steering, **({"total_steps": 1} if given.total_steps else {}))
    return default_config(given.algo if given.algo in ALGORITHMS else PPOConfig.name, given.backend or "warp")


def format_summary(summary: TrainingSummary) -> str:
    """Formats the result of a training run and the shares of its time, or says why nothing was trained."""
    if summary.reached_before:
        used = {"total_steps": f"{summary.steps:,}", "max_minutes": f"{summary.minutes:.1f}"}
        options = " ".join(f"--{name.replace('_', '-')} {name[0].upper()}" for name in summary.reached_before)
        least = " and ".join(f"{name[0].upper()} above {used[name]}" for name in summary.reached_before)
        return (
            f"{summary.folder} had reached its limit before and was trained no further, after {used['total_steps']} "
            f"steps in {used['max_minutes']} minutes. To train it longer: rover-rl train --resume {summary.folder} "
            f"{options}, with {least}"
        )
    stopped = "Interrupted" if summary.interrupted else "Finished"
    resume = f"\nTo continue: rover-rl train --resume {summary.folder}" if summary.interrupted else ""
    took = f"{summary.steps:,} steps in {summary.minutes:.1f} minutes"
    shares = ", ".join(f"{name} {share:.0%}" for name, share in summary.shares.items())
    return f"{stopped} after {took}: {summary.checkpoint}\nTime went into: {shares}{resume}"
