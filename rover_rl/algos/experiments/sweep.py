"""Search for better settings with Optuna: each trial is a training run in a folder of its own, and is evaluated.

Example:
    >>> config = training_config("ppo", world="maze", num_envs=8, total_steps=512)
    >>> sweep = Sweep(config, read_space(["gamma=0.9,0.99"], config), Path("runs/sweep-maze"), episodes=2)
    >>> sweep.run(trials=1, say=print)
    >>> sweep.settings(sweep.finished[0])["gamma"] in (0.9, 0.99)
    True
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path
from random import Random
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

from matplotlib.figure import Figure
from matplotlib.ticker import PercentFormatter
from rich.console import Console

from rover_rl.algos.config import TrainingConfig, with_settings
from rover_rl.algos.config_files import config_from, differing_settings, plain
from rover_rl.algos.evaluation.episodes import EpisodeSet, draw_episodes
from rover_rl.algos.evaluation.evaluate import environment_for
from rover_rl.algos.evaluation.metrics import Estimate
from rover_rl.algos.evaluation.parallel import GoalRequest, evaluate_all
from rover_rl.algos.evaluation.plots import BLUE, ORANGE, style_axes
from rover_rl.algos.evaluation.results import Evaluation
from rover_rl.algos.evaluation.tables import Column, cell, print_tables, write_rows
from rover_rl.algos.experiments.seeds import continued
from rover_rl.algos.experiments.space import Choice, Interval, Setting, with_varied
from rover_rl.algos.policy.checkpoint import Checkpoint
from rover_rl.algos.train import train
from rover_rl.algos.train.run_folder import training_lock
from rover_rl.files import written_whole
from rover_rl.worlds.names import TRAINING_SEEDS, WorldRange

if TYPE_CHECKING:
    from optuna import Study
    from optuna.trial import FrozenTrial

STUDY = "sweep.db"  # name of the file with the trials: a SQLite database of Optuna
EPISODES = 64  # default number of episodes in which each trial is evaluated
VALIDATION_SEED = 30_000
"""Seed of these episodes. They are neither those of training nor those that ``rover-rl evaluate`` drives."""
VALIDATION_WORLDS = 16  # number of worlds in which trials are evaluated after training in a range of worlds


_COLUMNS = 4  # largest number of panels in a row


class Sweep:
    """Search for the settings with the highest success rate.

    Settings are proposed by Optuna's tree-structured Parzen estimator; if all are choices, combinations are tried in a
    random order, each once. Everything is written to the folder after each trial, so that a sweep that was ended goes
    on from there, with the trial that was interrupted.

    Args:
        config: settings that do not vary, also the seed of all trials.
        space: settings that vary: see :func:`~rover_rl.algos.experiments.space.read_space`.
        folder: folder of the sweep, new or existing. Trials are in ``trial-0``, ``trial-1``, ...
        episodes: number of episodes in which each trial is evaluated.

    Raises:
        ImportError: if Optuna is missing.
        FileExistsError: if the folder holds a sweep with other settings.
    """

    def __init__(
        self, config: TrainingConfig, space: Sequence[Setting], folder: Path, episodes: int = EPISODES
    ) -> None:
        self.config, self.space, self.folder = config, list(space), folder
        self._count, self._study = episodes, _open_study(folder)
        self._require_same()

    def _require_same(self) -> None:
        stated = {"vary": [str(setting) for setting in self.space], "episodes": self._count}
        saved = self._study.user_attrs
        if not saved:
            for key, value in {**stated, "config": plain(self.config)}.items():
                self._study.set_user_attr(key, value)
            return
        others = [key for key, value in stated.items() if saved.get(key) != value]
        others += differing_settings(self.config, config_from(saved.get("config"), str(self.folder / STUDY)))
        if others:
            raise FileExistsError(
                f"there is a sweep {self.folder} already, with other {', '.join(others)}; choose another --name"
            )

    @property
    def finished(self) -> list[FrozenTrial]:
        """Trials with a result, the best first: by success rate, then by the mean time to a goal."""
        trials = [trial for trial in self._study.get_trials() if trial.value is not None]
        return sorted(trials, key=lambda trial: (-(trial.value or 0.0), trial.user_attrs["seconds"]))

    def settings(self, trial: FrozenTrial) -> dict[str, Any]:
        """Returns the varied settings of a trial, by name."""
        return {setting.name: setting.value(trial.params[setting.name]) for setting in self.space}

    def trial_folder(self, trial: FrozenTrial) -> Path:
        """Returns the folder of a trial's run."""
        return self.folder / f"trial-{trial.number}"

    def run(self, trials: int, say: Callable[[str], None]) -> bool:
        """Trains and evaluates until there are ``trials`` trials, those of earlier calls included.

        A trial that diverges, or whose settings do not fit each other, counts as failed. ``say`` reports what happens.
        Returns whether the sweep is complete; false after Ctrl-C.
        """
        with training_lock(self.folder):
            return self._run(trials, say)

    def _run(self, trials: int, say: Callable[[str], None]) -> bool:
        episodes = validation_episodes(self.config, self._count)
        while (trial := self._next(trials)) is not None:
            values = self.settings(trial)
            settings = " ".join(f"{name}={text_of(value)}" for name, value in values.items())
            say(f"Trial {trial.number + 1} of {trials}: {settings}")
            try:
                folder = self.trial_folder(trial)
                config = with_settings(with_varied(self.config, values), runs=str(self.folder), name=folder.name)
                config.check()
                summary = train(*continued(config))
            except (FloatingPointError, ValueError) as error:
                say(f"Trial {trial.number + 1} failed: {error}")
                self._tell(trial, None)
                continue
            if summary.interrupted:
                return False
            result = self._evaluate(folder, episodes)
            seconds = result.metrics["mean_time_to_traverse"].value
            success = result.metrics["success_rate"]
            attributes = {"seconds": seconds, "low": success.low, "high": success.high, "minutes": summary.minutes}
            self._tell(trial, success.value, attributes)
            say(f"Trial {trial.number + 1} of {trials}: success {success.value:.0%} in {len(episodes)} episodes")
        return True

    def _next(self, trials: int) -> FrozenTrial | None:
        from optuna.samplers import TPESampler
        from optuna.trial import TrialState

        known = self._study.get_trials()
        if interrupted := [trial for trial in known if trial.state == TrialState.RUNNING]:
            return interrupted[0]
        if len(known) >= trials:
            return None
        if all(isinstance(setting, Choice) for setting in self.space):
            tried = [trial.params for trial in known]
            names = [setting.name for setting in self.space]
            combinations = product(*(setting.values for setting in self.space if isinstance(setting, Choice)))
            left = [params for values in combinations if (params := dict(zip(names, values, strict=True))) not in tried]
            if not left:
                return None
            self._study.enqueue_trial(Random(self.config.seed + len(known)).choice(left))
        # A new sampler for each trial, so that the proposals do not depend on interruptions.
        self._study.sampler = TPESampler(seed=self.config.seed + len(known))
        number = self._study.ask({setting.name: setting.distribution() for setting in self.space}).number
        return self._study.get_trials()[number]

    def _tell(self, trial: FrozenTrial, value: float | None, attributes: dict[str, float] | None = None) -> None:
        from optuna.trial import TrialState

        storage = self._study._storage
        for key, attribute in (attributes or {}).items():
            storage.set_trial_user_attr(trial._trial_id, key, attribute)
        self._study.tell(trial.number, value, state=TrialState.FAIL if value is None else None)

    def _evaluate(self, folder: Path, episodes: EpisodeSet) -> Evaluation:
        actor = Checkpoint.load(folder).make_actor()
        env = replace(environment_for(actor, None), backend=self.config.env.backend, device=self.config.env.device)
        (result,) = evaluate_all([GoalRequest(actor, episodes, {"name": folder.name, "env": env})])
        assert isinstance(result, Evaluation)
        return result


def text_of(value: Any) -> str:
    """Returns the value of a setting as text."""
    return f"{value:g}" if isinstance(value, float) else str(value)


def validation_episodes(config: TrainingConfig, count: int) -> EpisodeSet:
    """Draws episodes to choose settings by, in the worlds of the training.

    After training in a range of worlds, they are in the last worlds with a seed for training, which a smaller range
    does not contain. They are not those of ``rover-rl evaluate``, which tell how good the chosen settings are.
    """
    worlds: list[Any] = []
    for world in config.env.worlds:
        seeds = WorldRange.parse(world) if isinstance(world, str) else None
        if seeds is None:
            worlds.append(world)
        else:
            last = replace(seeds, first=TRAINING_SEEDS - VALIDATION_WORLDS, last=TRAINING_SEEDS - 1)
            worlds += [last.name(number) for number in range(min(VALIDATION_WORLDS, count))]
    each = max(1, count // len(worlds))
    return draw_episodes(worlds, each, VALIDATION_SEED, robot=config.env.robot)


def _open_study(folder: Path) -> Study:
    try:
        import optuna
    except ImportError as error:
        raise ImportError('sweeps need Optuna: pip install "rover_rl[sweep]"') from error
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    folder.mkdir(parents=True, exist_ok=True)
    storage = f"sqlite:///{folder / STUDY}"
    return optuna.create_study(storage=storage, study_name=folder.name, direction="maximize", load_if_exists=True)


def print_trials(sweep: Sweep, console: Console | None = None) -> None:
    """Prints a table of the trials with a result, the best first."""
    console, trials = console or Console(), sweep.finished
    results = [(sweep.settings(trial), SimpleNamespace(**trial.user_attrs), trial.value or 0.0) for trial in trials]
    success = [cell(Estimate(value, result.low, result.high), "%") for _, result, value in results]
    columns = [Column(one.name, "", [text_of(values[one.name]) for values, *_ in results]) for one in sweep.space]
    columns += [
        Column("success", "%", success),
        Column("time", "s", [cell(Estimate(one.seconds, math.nan, math.nan), "s") for _, one, _ in results]),
        Column("training", "min", [f"{one.minutes:.1f}" for _, one, _ in results]),
    ]
    names = [f"trial-{trial.number}" for trial in trials]
    print_tables(str(sweep.folder), names, columns, console, heading="trial")
    console.print(
        "below a success: 95 % confidence interval, within which trials are not told apart; time: mean time to a goal.",
        style="dim",
        highlight=False,
    )


def write_trials(sweep: Sweep, path: Path) -> None:
    """Writes the trials with a result as CSV, the best first."""
    rows = []
    for trial in sweep.finished:
        settings = {"trial": sweep.trial_folder(trial).name, **sweep.settings(trial)}
        rows.append(settings | {"success": trial.value, **trial.user_attrs})
    write_rows(path, rows)


def draw_trials(sweep: Sweep, path: Path) -> None:
    """Draws the success rate of each trial, with its 95 % interval, against each setting that varies."""
    trials, columns = sweep.finished, min(_COLUMNS, len(sweep.space))
    rows = math.ceil(len(sweep.space) / columns)
    figure = Figure(figsize=(1.2 + 3.4 * columns, 3.4 * rows), layout="constrained")
    panels = figure.subplots(rows, columns, squeeze=False, sharey=True).flat
    for ax, setting in zip(panels, sweep.space, strict=False):
        order = [*setting.values] if isinstance(setting, Choice) else []
        for place, trial in reversed([*enumerate(trials)]):
            drawn, rate = trial.params[setting.name], trial.value or 0.0
            ends = [[rate - trial.user_attrs["low"]], [trial.user_attrs["high"] - rate]]
            # Trials with the same choice stand side by side.
            side = 0.5 * (trial.number + 0.5) / len(trials) - 0.25
            x = order.index(drawn) + side if order else setting.value(drawn)
            color = BLUE if place else ORANGE
            label = None if place else f"best trial: {trial.number}"
            ax.errorbar(x, rate, ends, fmt="o", color=color, elinewidth=0.8, clip_on=False, label=label)
        if order:
            ax.set_xticks(range(len(order)), order)
            ax.set_xlim(-0.5, len(order) - 0.5)
        elif isinstance(setting, Interval):
            # Trials at the ends are not cut.
            ax.set(xscale="log" if setting.log else "linear", xlim=(setting.low, setting.high))
            ax.margins(x=0.05)
        ax.set(xlabel=setting.name, ylim=(0, 1.02))
        ax.yaxis.set_major_formatter(PercentFormatter(1.0))
        style_axes(ax)
    figure.axes[0].set_ylabel("success rate")
    figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="outside lower center", frameon=False)
    for ax in figure.axes[len(sweep.space) :]:
        ax.remove()
    with written_whole(path) as temporary:
        figure.savefig(temporary, dpi=150)
