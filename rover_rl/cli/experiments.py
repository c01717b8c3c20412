"""The commands ``rover-rl compare`` and ``rover-rl sweep``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from rover_rl.algos.config import TrainingConfig
from rover_rl.algos.experiments.space import Setting, read_space
from rover_rl.checks import MAX_COUNT, check_at_least
from rover_rl.cli.train import FLAT, INTERRUPTED, Train, train_defaults
from rover_rl.files import check_outputs


@dataclass(frozen=True)
class Compare:
    """Compare training runs by their learning curves, over several seeds.

    Writes comparison.png, comparison.csv, runs.csv and comparison.json.
    """

    runs: Annotated[
        tyro.conf.Positional[tuple[str, ...]],
        tyro.conf.arg(help="Folders of runs, folders that hold runs, or runs/NAME for runs/NAME-seed0 and so on."),
    ]
    success: float = 0.9
    """Success rate that a run takes some steps and minutes to."""
    out: Path = Path("runs/comparison")
    """Folder to write to."""
    force: bool = False
    """Write over files that rover-rl did not make."""

    def __call__(self) -> int:
        """Runs the command."""
        from rover_rl.algos.experiments.comparison import compare, print_comparison, write_comparison
        from rover_rl.algos.experiments.runs import find_runs

        files = ("comparison.png", "comparison.csv", "runs.csv", "comparison.json")
        check_outputs(*(self.out / file for file in files), force=self.force)
        comparison = compare(find_runs(self.runs), self.success)
        write_comparison(comparison, self.out)
        print_comparison(comparison)
        print(f"Results: {self.out / 'comparison.json'}, comparison.csv, runs.csv")
        print(f"Learning curves: {self.out / 'comparison.png'}")
        return 0


@dataclass(frozen=True)
class SweepCommand:
    """Search for better settings of training with Optuna (extra sweep). Options of train hold for all trials.

    Each trial is a training run in a folder of its own, and is evaluated in new episodes. Ctrl-C keeps all trials; the
    same command goes on.
    """

    vary: tuple[str, ...] = ()
    """Settings to vary: NAME=LOW..HIGH or NAME=A,B,C, such as learning_rate=1e-4..3e-3 gamma=0.95,0.97.
    Values are drawn log-uniformly if the ends differ by a factor of ten or more."""
    trials: int = 8
    """Number of trials, those of an earlier call of the same command included."""
    episodes: int = 64
    """Number of episodes in which each trial is evaluated."""
    training: Annotated[Train, FLAT] = field(default_factory=Train)
    force: bool = False
    """Write over files that rover-rl did not make."""

    def __call__(self) -> int:
        """Runs the command."""
        if self.training.seeds or self.training.resume:
            raise ValueError("sweep takes neither --seeds nor --resume: the same command continues a sweep")
        check_at_least(1, MAX_COUNT, trials=self.trials, episodes=self.episodes)
        config = self.training.config
        config.check()
        space = read_space(self.vary, config)
        for setting in space:
            print(setting, flush=True)
        return self._run(config, space)

    def _run(self, config: TrainingConfig, space: list[Setting]) -> int:
        from rover_rl.algos.experiments.sweep import STUDY, Sweep, draw_trials, print_trials, write_trials
        from rover_rl.algos.train.run_folder import default_name

        folder = Path(config.run.runs, config.run.name or f"sweep-{default_name(config)}")
        check_outputs(
            *(folder / file for file in (STUDY, "trials.csv", "trials.png")), force=self.force, option="--runs"
        )
        sweep = Sweep(config, space, folder, self.episodes)
        try:
            complete = sweep.run(self.trials, lambda text: print(text, flush=True))
        except KeyboardInterrupt:
            complete = False
        if sweep.finished:
            print_trials(sweep)
            write_trials(sweep, folder / "trials.csv")
            draw_trials(sweep, folder / "trials.png")
            print(f"Trials: {folder / 'trials.csv'}, trials.png")
            best = sweep.trial_folder(sweep.finished[0])
            place = f"--runs {config.run.runs} --name {folder.name}-best --seeds 0 1 2"
            print(f"To train with the best settings:\nrover-rl train --config {best / 'config.yaml'} {place}")
        if not complete:
            print("Interrupted. The same command goes on from there.")
        return 0 if complete else INTERRUPTED


def sweep_defaults(args: Sequence[str]) -> SweepCommand:
    """Returns the command with the defaults of its options: see :func:`~rover_rl.cli.train.train_defaults`."""
    training = train_defaults(["train", *args[1:]] if args[:1] == ["sweep"] else [])
    return SweepCommand(training=training)
