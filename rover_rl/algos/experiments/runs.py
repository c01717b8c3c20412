"""Records of training runs, and the experiments that they belong to.

A run's record is what its folder holds: ``config.yaml``, ``progress.csv`` and, after ``rover-rl evaluate``,
``evaluation.json``.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, TypeAlias

import numpy as np
from tensordict import TensorDictBase

from rover_rl.algos.config import PPOConfig, TrainingConfig, with_settings
from rover_rl.algos.config_files import SEED_SUFFIX, differing_settings, experiments, run_config
from rover_rl.algos.policy.checkpoint import CHECKPOINT, SETTINGS
from rover_rl.algos.train.ppo import PPOLearner
from rover_rl.algos.train.progress import EPISODE_STEPS, TIME, read_progress
from rover_rl.algos.train.run_folder import STATE, default_name, load_state
from rover_rl.envs.config import EnvConfig

Against: TypeAlias = Literal["steps", "minutes"]
"""Quantity that the progress of a run is measured against: environment steps of all rovers, or minutes of training."""
Measure: TypeAlias = Literal["success", "goals"]
"""Measure of a training run: success rate (attempts to reach a goal), or goals per 2,000 steps."""
PROGRESS = "progress.csv"
EVALUATION = "evaluation.json"
WINDOW = 1 / 12  # width of the averaging window of a curve, as a fraction of the run
_POINTS = 480  # number of points at which a curve is searched for a level
_SHOWN = 400  # number of points of a curve of RunFiles at most: a long run has more rows


@dataclass(frozen=True)
class Run:
    """Record of a training run, with the values of each row of its table, ``[rows]``."""

    folder: Path
    config: TrainingConfig
    x: dict[str, np.ndarray]
    measures: dict[str, tuple[np.ndarray, np.ndarray]]  #: Numerators and denominators of each measure.
    shares: dict[str, np.ndarray]  #: Shares of the time, by their columns.

    @classmethod
    def read(cls, folder: str | Path) -> Run:
        folder = Path(folder)
        config = run_config(folder)
        columns = {key: np.array(values) for key, values in read_progress(folder / PROGRESS).items()}
        if not columns:
            raise ValueError(f"{folder / PROGRESS} holds no rows yet")
        full_episodes = np.diff(columns["steps"], prepend=0) / EPISODE_STEPS
        success = columns["attempts_reached"], columns["attempts"]
        goals = columns["goals_per_2000_steps"] * full_episodes, full_episodes
        x = {"steps": columns["steps"], "minutes": columns["minutes"]}
        shares = {name: values for name, values in columns.items() if name.startswith(TIME)}
        return cls(folder, config, x, {"success": success, "goals": goals}, shares)

    def end(self, against: Against) -> float:
        return float(self.x[against][-1])

    def curve(self, measure: Measure, against: Against, at: np.ndarray, width: float) -> np.ndarray:
        """Ratio of sums of a measure over windows of ``width`` around ``at [points]``; nan where nothing is counted."""
        edges = np.concatenate(([0.0], self.x[against]))

        def window_sums(values: np.ndarray) -> np.ndarray:
            total = np.concatenate(([0.0], np.cumsum(values)))
            return np.interp(at + width / 2, edges, total) - np.interp(at - width / 2, edges, total)

        numerators, denominators = self.measures[measure]
        with np.errstate(invalid="ignore"):
            return window_sums(numerators) / window_sums(denominators)

    @property
    def final_success(self) -> float:
        """Success rate in the last twelfth of the run's steps; nan if no episode ended in it."""
        end, width = self.end("steps"), self.end("steps") * WINDOW
        return float(self.curve("success", "steps", np.array([end - width / 2]), width)[0])

    def first_at(self, success: float, against: Against) -> float:
        """Steps or minutes until the curve of the success rate first reaches a level; infinity if it does not."""
        at = np.linspace(0, self.end(against), _POINTS)
        reached = at[self.curve("success", against, at, self.end(against) * WINDOW) >= success]
        return float(reached[0]) if len(reached) else float("inf")


@dataclass(frozen=True)
class Experiment:
    """Runs that differ in their seed at most. The title has the settings in which others differ."""

    title: str
    world: str
    runs: list[Run] = field(default_factory=list)

    @property
    def settings(self) -> str:
        """Title without the world, the same for experiments with the same settings in several worlds."""
        return self.title.replace(f" in {self.world}", "", 1)

    @property
    def name(self) -> str:
        """Name that the folders of the runs share before their seed; without one, the settings."""
        names = {re.sub(rf"{SEED_SUFFIX}\d+$", "", run.folder.name) for run in self.runs}
        shared = len(names) == 1 and {run.folder.name for run in self.runs} != names
        return names.pop() if shared or len(self.runs) == 1 else self.settings

    def end(self, against: Against) -> float:
        return min(run.end(against) for run in self.runs)


def group(runs: Sequence[Run]) -> list[Experiment]:
    found: dict[str, Experiment] = {}
    for name, run in zip(experiments([run.config for run in runs]), runs, strict=True):
        world = ", ".join(run.config.env.world_names)
        found.setdefault(name, Experiment(name, world)).runs.append(run)
    return list(found.values())


def find_runs(words: Sequence[str]) -> list[Path]:
    """Returns the folders of the runs that words name.

    A word is the folder of a run, a folder that holds runs, or ``runs/NAME`` for ``runs/NAME-seed0`` and so on. Raises
    ``FileNotFoundError`` if it names no run.
    """
    found: dict[Path, None] = {}
    for path in map(Path, words):
        named = [path] if (path / SETTINGS).is_file() else [file.parent for file in path.glob(f"*/{PROGRESS}")]
        named = named or [*path.parent.glob(f"{path.name}{SEED_SUFFIX}*")]
        if not named:
            raise FileNotFoundError(f"no run at {path}, no folder with runs, and no {path}{SEED_SUFFIX}0")
        found |= dict.fromkeys(sorted(named, key=_natural))
    return list(found)


def _natural(path: Path) -> list[Any]:
    return [int(part) if part.isdigit() else part for part in re.split(r"(\d+)", path.name)]


def evaluated_success(runs: Sequence[Run]) -> tuple[str, dict[Path, float]] | None:
    """Success rates of the runs' policies in the same evaluation, by folder, and what it was.

    ``rover-rl evaluate`` writes several policies' results into the first one's folder. Older ones than a checkpoint do
    not count.
    """
    rates: dict[str, dict[Path, float]] = {}
    checkpoints = {run.folder: run.folder / CHECKPOINT for run in runs if (run.folder / CHECKPOINT).is_file()}
    for file in (run.folder / EVALUATION for run in runs if (run.folder / EVALUATION).is_file()):
        written = file.stat().st_mtime
        for result in json.loads(file.read_text()):
            if result.get("mode") != "one goal":
                continue
            title = "{count} episodes in {world}, {time_limit:g} s, {backend}".format(**result)
            for folder, checkpoint in checkpoints.items():
                if result["policy"] == folder.name and checkpoint.stat().st_mtime <= written:
                    rates.setdefault(title, {})[folder] = result["metrics"]["success_rate"]["value"]
    return next(((title, found) for title, found in rates.items() if len(found) == len(runs)), None)


def seed_runs(config: TrainingConfig, seeds: Sequence[int]) -> list[tuple[TrainingConfig, Path | None]]:
    """Returns the settings of a run for each seed, and the folder of the run if it exists, to continue it.

    So an interrupted experiment goes on where it was. A run that exists keeps its own settings where these do not
    change what is learned, such as its backend. The folders' names begin with that in ``config``, by default such as
    ``ppo-moon``.

    Raises a ``ValueError`` for no or repeated seeds, or a setting out of range, and a ``FileExistsError`` if there is a
    run of that name with other settings.
    """
    if not seeds or len(set(seeds)) < len(seeds):
        raise ValueError(f"seeds must be at least one, each once, got {tuple(seeds)}")
    name = config.run.name or default_name(config)
    runs = [with_settings(config, seed=seed, name=f"{name}{SEED_SUFFIX}{seed}") for seed in seeds]
    for run in runs:
        run.check()
    return [continued(run) for run in runs]


def continued(config: TrainingConfig) -> tuple[TrainingConfig, Path | None]:
    """Returns the settings and the folder of the run that ``config`` names; ``None`` if it does not exist yet."""
    folder = Path(config.run.runs, config.run.name or "")
    if not folder.exists():
        return config, None
    saved = run_config(folder)
    if others := ", ".join(differing_settings(config, saved)):
        raise FileExistsError(
            f"there is a run {folder} already, with other settings of {others}; choose another --name"
        )
    return saved, folder


class RunFiles:
    """Folder of a run, which may still be training."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    @classmethod
    def find(cls, path: Path) -> RunFiles | None:
        return cls(path) if (path / SETTINGS).is_file() else None

    @property
    def env(self) -> EnvConfig:
        return run_config(self.folder).env

    def policies(self) -> list[Path]:
        """Returns the files of the policies, first to last: the snapshots, then the checkpoint."""
        last = self.folder / CHECKPOINT
        return [*sorted((self.folder / "snapshots").glob("*.pt")), *([last] if last.is_file() else [])]

    def critic(self) -> Callable[[TensorDictBase], float] | None:
        """Returns the function that estimates the value of an observation ``[1]``, as of the last checkpoint.

        ``None`` if the run has none: before the first checkpoint, with SAC, or if it reads what a policy does not see.
        """
        config, path = run_config(self.folder), self.folder / STATE
        if not isinstance(config.algorithm, PPOConfig) or config.network.privileged_critic or not path.is_file():
            return None
        learner = PPOLearner(with_settings(config, device=None, imitation=0.0))
        learner.load_state_dict(load_state(path)["learner"])
        critic, scale = learner.critic, config.algorithm.reward_scale
        return lambda observation: critic(observation.select(*critic.in_keys))["state_value"].item() / scale

    def curves(self) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        """Returns the steps, ``[points]``, and curves over them; empty before the first row.

        They are the success rate, the goals in 2,000 steps, and the shares of the time, as :data:`TIME` and a name.
        """
        try:
            run = Run.read(self.folder)
        except (OSError, ValueError):
            return np.zeros(0), {}
        rows, end = len(run.x["steps"]), run.end("steps")
        # The last row is always among the points.
        shown = slice((rows - 1) % (step := -(-rows // _SHOWN)), None, step)
        steps, width = run.x["steps"][shown], max(WINDOW, 1 / rows) * end
        curves = {name: values[shown] for name, values in run.shares.items()}
        measures: dict[str, Measure] = {"success rate": "success", "goals in 2000 steps": "goals"}
        for title, measure in measures.items():
            curves[title] = np.nan_to_num(run.curve(measure, "steps", steps - width / 2, width))
        return steps, curves
