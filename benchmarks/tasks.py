"""Scores of learners, other libraries and planners in the tasks, each by one command.

    python -m benchmarks.tasks mazes ppo --seed 1
    python -m benchmarks.tasks mazes gridplanner
    python -m benchmarks.tasks mazes checkpoint.pt --name mine

An entry is a learner of the task (ppo, ppo-gru, sac), another library (sb3, rsl_rl, skrl, cleanrl), or a policy that is
there already: a planner, a run, a checkpoint, an ONNX file, a .zip of Stable-Baselines3, or module:attribute. Learners
and libraries are trained first, in runs/tasks; the same command continues a learner's training that was interrupted.
The test of the task judges the policy, and its card, a JSON file, is written to benchmarks/results. --missing makes all
cards of the table that do not exist, and --draw draws the page docs/task_results.md from the cards.
"""

from __future__ import annotations

import math
import os
import platform
import sys
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import tyro

from benchmarks import other_libraries
from benchmarks.other_libraries import LIBRARIES, Meter, OtherActor, run_program
from benchmarks.task_page import CARDS, PAGE, draw, read_cards, write_card
from rover_rl import LEARNING_DEFAULTS, __version__
from rover_rl.algos.config import SACConfig, task_config, with_settings
from rover_rl.algos.evaluation.episodes import choose_episodes
from rover_rl.algos.evaluation.evaluate import Request, evaluate_all, for_task, test_env
from rover_rl.algos.evaluation.metrics import compute_metrics
from rover_rl.algos.evaluation.results import Evaluation
from rover_rl.algos.experiments.runs import WINDOW, Run, continued
from rover_rl.algos.policy.names import BASELINES, PRETRAINED, RANDOM, ResolvedPolicy, is_baseline, resolve_policy
from rover_rl.algos.policy.runner import Policy
from rover_rl.algos.train import train
from rover_rl.tasks import Task, get_task, task_names

POINTS = 50  # largest number of points of a learning curve in a card
STEPS, STEPS_OF_SAC = 10_000_000, 1_000_000
TABLE, SEEDS = ("ppo", "ppo-gru", "sb3"), (1, 2, 3)  # entries and seeds that --missing trains
PLANNERS = (*BASELINES, RANDOM)
METRICS = ("spl", "mean_time_to_traverse", "body_contact_share")
PROGRAMS = Path(__file__).parents[1] / "examples" / "other_libraries"
INTERRUPTED = 130  # exit code after Ctrl-C


@dataclass(frozen=True)
class Options:
    """Judge an entry in a task."""

    task: tyro.conf.Positional[str | None] = None
    """Name of a task (rover-rl tasks), or module:attribute."""
    entry: tyro.conf.Positional[str | None] = None
    """Learner, library, planner, or policy."""
    name: str | None = None
    """Name of the entry in the table, for a policy that is there already."""
    seed: int = 1
    """Seed of the training."""
    steps: int | None = None
    """Number of steps of the training, all rovers together. Default: 10 million; for SAC, 1 million."""
    action_repeat: int | None = None
    """Number of steps that each action is held for. Default: as in rover-rl evaluate, and 4 for other libraries."""
    program: Path | None = None
    """CleanRL's ppo_continuous_action.py, for the entry cleanrl."""
    missing: bool = False
    """Make the cards of the table that do not exist, of all tasks or of the one that is named."""
    draw: bool = False
    """Draw the page from the cards."""
    out: Path = CARDS
    """Folder of the cards."""
    page: Path = PAGE
    """Page with the tables. Its picture is in images beside it."""
    runs: Path = Path("runs/tasks")
    """Folder of the trainings."""

    @property
    def label(self) -> str:
        """Name in the table, which tells of another budget than the default, as in ppo-100M."""
        budget = f"-{self.steps / 1e6:g}M" if self.steps and self.entry not in PLANNERS else ""
        return self.name or f"{self.entry}{budget}"

    def card(self, task: Task) -> Path:
        return self.out / task.name / f"{self.label}{'' if self.entry in PLANNERS else f'-seed{self.seed}'}.json"


@dataclass
class Trained:
    """A policy, with the learning curve of its training if that is known. A planner may drive beside it."""

    policy: Policy | None
    curve: dict[str, list[float]] = field(default_factory=dict)
    with_planner: bool = False
    action_repeat: int | None = None
    workers: int | None = None


def train_other(task: Task, folder: Path, options: Options) -> Trained:
    """Trains with the program of another library, with its own settings, in a folder."""
    repeat, steps = LEARNING_DEFAULTS["action_repeat"], options.steps or STEPS
    program, words = PROGRAMS / f"{options.entry}_ppo.py", [task.name, str(options.seed), str(steps // repeat)]
    if options.entry == "cleanrl":
        if options.program is None:
            raise ValueError("the entry cleanrl needs --program ppo_continuous_action.py, of CleanRL's repository")
        program, names = options.program.resolve(), ("--env-id", "--seed", "--total-timesteps")
        words = [*map("=".join, zip(names, [f"rover_rl:{task.gym_id}", *words[1:]], strict=True))]
    meter = Meter(other_libraries.Options(str(program), reports=POINTS), total=steps)
    folder.mkdir(parents=True, exist_ok=True)
    begin = Path.cwd()
    os.chdir(folder)
    try:
        act = LIBRARIES[str(options.entry)](run_program(program, words, meter))
    finally:
        os.chdir(begin)
    return Trained(OtherActor(task, act), meter.points, action_repeat=repeat, workers=1)


def train_own(task: Task, folder: Path, options: Options) -> Trained:
    """Trains a learner of the task, or continues its training. Raises ``KeyboardInterrupt`` if it is interrupted."""
    config = task_config(task.name, options.entry, seed=options.seed, name=folder.name, runs=str(folder.parent))
    steps = options.steps or (STEPS_OF_SAC if isinstance(config.algorithm, SACConfig) else STEPS)
    if train(*continued(with_settings(config, total_steps=steps))).interrupted:
        raise KeyboardInterrupt
    return load(task, str(folder))


def load(task: Task, entry: str) -> Trained:
    """Makes or loads a policy, with the learning curve of its run if that is there."""
    if not (is_baseline(entry) or entry == RANDOM or entry.startswith(PRETRAINED) or Path(entry).exists()):
        raise ValueError(
            f"entry must be a learner of the task, one of {[*task.learners]}, a library, one of {[*LIBRARIES]}, a "
            f"planner, one of {[*PLANNERS]}, a file, or module:attribute, got {entry!r}"
        )
    found = resolve_policy(entry, ("worlds of the test",), task.test_env.robot)
    curve: dict[str, list[float]] = {}
    if found.folder is not None:
        with suppress(OSError, ValueError):  # a checkpoint may be alone, without its run
            run = Run.read(found.folder)
            end = run.end("steps")
            at = np.linspace(0, end, POINTS + 1)[1:]
            success = run.curve("success", "steps", at, end * WINDOW)
            minutes = np.interp(at, run.x["steps"], run.x["minutes"])
            curve = {"steps": at.tolist(), "minutes": minutes.tolist(), "success": success.tolist()}
    return Trained(found.module, curve, with_planner=has_planner(found))


def has_planner(found: ResolvedPolicy) -> bool:
    """Whether a policy drives with a planner: as the prior of its network, in its action, or by the route it reads."""
    residual = (env := getattr(found.module, "made_for", None)) is not None and env.action.kind == "residual"
    network = found.config and found.config.network
    return residual or (network is not None and (network.prior != "none" or "route" in network.observation))


def judge(task: Task, found: Trained, name: str, action_repeat: int | None) -> list[Evaluation]:
    """Evaluates a policy in a task's test, as ``rover-rl evaluate TASK POLICY`` does: once for each range of worlds."""
    env = test_env(task, policy := for_task(task, found.policy))
    options = {"name": name, "env": env, "seconds": task.seconds, "action_repeat": action_repeat}
    sets = [choose_episodes(one, task.episodes, robot=env.robot, workers=found.workers) for one in env.world_names]
    return evaluate_all([Request(policy, episodes, options) for episodes in sets], found.workers)


def make_card(options: Options, command: str) -> Path:
    """Trains an entry if it is trained, judges it, and writes its card, whose path it returns."""
    task, entry = get_task(str(options.task)), str(options.entry)
    path, ours, kind = options.card(task), {*task.learners, *LIBRARIES, *PLANNERS}, "learner"
    if entry in ours and options.name is not None:
        raise ValueError(f"{entry} is its name in the table: leave out --name")
    if entry in task.learners or entry in LIBRARIES:
        learn = train_own if entry in task.learners else train_other
        found = learn(task, options.runs / task.name / path.stem, options)
    else:
        found, kind = load(task, entry), "planner" if entry in PLANNERS else "entry"
        if kind == "entry" and options.name in (None, *ours):
            raise ValueError(f"an entry that is there already needs a name of its own: {entry} --name NAME")
    name, repeat = options.label, options.action_repeat or found.action_repeat
    driven = judge(task, found, name, repeat)
    rows, endings = [row for one in driven for row in one.table], Counter(end for one in driven for end in one.endings)
    metrics, curve = compute_metrics(rows), found.curve
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    steps, minutes = (curve[key][-1] if curve else math.nan for key in ("steps", "minutes"))
    machine = {"processor": platform.processor() or platform.machine(), "cores": cores}
    card = {"task": task.name, "entry": name, "kind": kind, "seed": None if kind == "planner" else options.seed}
    card |= {"steps": round(steps) if curve else None, "minutes": minutes, "with_planner": found.with_planner}
    card |= {"episodes": len(rows), "success": endings["goal"] / len(rows)}
    card |= {key: metrics[key].value for key in METRICS}
    card |= {"endings": dict(sorted(endings.items())), "version": __version__, "machine": machine}
    write_card(path, card | {"command": command, "curve": curve})
    return path


def missing(options: Options) -> Iterator[Options]:
    """Cells of the table without a card: first those of planners, then seed after seed."""
    tasks = [get_task(name) for name in ([options.task] if options.task else task_names())]
    cells = [(task, entry, 1) for task in tasks for entry in task.references]
    taught = [(task, entry) for task in tasks for entry in TABLE if entry in task.learners or entry in LIBRARIES]
    cells += [(task, entry, seed) for seed in SEEDS for task, entry in taught]
    for task, entry, seed in cells:
        cell = replace(options, task=task.name, entry=entry, seed=seed)
        if not cell.card(task).exists():
            yield cell


def main(options: Options) -> int:
    if not ((options.task and options.entry) or options.missing or options.draw):
        raise ValueError("name a task and an entry, such as mazes ppo, or give --missing or --draw")
    failed = 0
    for cell in missing(options) if options.missing else [options] * (options.entry is not None):
        command = f"python -m benchmarks.tasks {cell.task} {cell.entry}"
        command += f" --name {cell.name}" * bool(cell.name) + f" --steps {cell.steps}" * bool(cell.steps)
        command += f" --seed {cell.seed}" * (cell.entry not in PLANNERS)
        print(command, flush=True)
        try:
            print(f"Card: {make_card(cell, command)}", flush=True)
        except KeyboardInterrupt:
            print("Interrupted. The same command goes on.")
            return INTERRUPTED
        except (ValueError, ImportError, RuntimeError, ArithmeticError) as error:
            if not options.missing:
                raise
            print(f"failed: {error}", file=sys.stderr, flush=True)
            failed = 1
    if options.missing or options.draw:
        draw(read_cards(options.out), options.page)
    return failed


if __name__ == "__main__":
    raise SystemExit(main(tyro.cli(Options, description=__doc__)))
