"""Table and learning curves: trains the policies of the package with several seeds, and evaluates them.

    python -m benchmarks.results --policies moon-ppo moon-sac --seeds 0 1 2

Each training has the settings of the package's policy and uses the whole machine. A policy that was trained in ranges
of worlds is evaluated on the stored episodes of the first kind that has them. Evaluations run in parallel at the
end. Writes a folder for each run to ``runs/results/``, with ``evaluation.json`` and ``paths.png``, and for all runs
``results.md``, ``results.json`` and ``learning_curves.png``. A second call continues: it repeats no complete training
or evaluation.
"""

from __future__ import annotations

import json
import statistics
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import tyro

from benchmarks.stored import stored_policies, stored_worlds
from rover_rl.algos.config import UNLIMITED_STEPS, TrainingConfig, with_settings
from rover_rl.algos.config_files import run_config
from rover_rl.algos.evaluation.cores import over_cores
from rover_rl.algos.evaluation.episodes import EpisodeSet, draw_episodes, endless_episodes, stored_episodes
from rover_rl.algos.evaluation.evaluate import Evaluation, evaluate
from rover_rl.algos.evaluation.plots import draw_paths
from rover_rl.algos.evaluation.report import write_evaluation
from rover_rl.algos.experiments.curves import draw_learning_curve
from rover_rl.algos.policy.checkpoint import Checkpoint
from rover_rl.algos.pretrained import load_pretrained
from rover_rl.algos.train import train
from rover_rl.algos.train.progress import read_progress
from rover_rl.files import write_json, written_whole

SUCCESS_THRESHOLD = 0.9  # success rate whose number of training steps is reported
OTHER_MAZES = ("maze:10001", "maze:10002", "maze:10003")  # mazes that no policy was trained in
FEW_EPISODES = 128  # number of episodes for snapshots and other mazes
INTERRUPTED = 130  # exit code after Ctrl-C


@dataclass
class Options:
    """Train the policies of the package with several seeds, and evaluate them."""

    policies: list[str] = field(default_factory=stored_policies)
    """Names of the policies of the package."""
    seeds: list[int] = field(default_factory=lambda: [0, 1, 2])
    """Seeds of weights, actions, starts and goals."""
    minutes: float | None = None
    """Duration of each training in minutes. Default: the number of steps of the package's policy."""
    count: int = 256
    """Number of stored episodes."""
    seconds: float = 60.0
    """Time limit of an episode, s."""
    endless: int = 32
    """Number of episodes in endless mode, with the jam ending and without."""
    runs: Path = Path("runs/results")
    """Output folder."""


def settings(name: str, seed: int, options: Options) -> TrainingConfig:
    config = load_pretrained(name).config
    config = with_settings(config, seed=seed, name=f"{name}-{seed}", runs=str(options.runs), workers=None)
    if options.minutes is None:
        return config
    return with_settings(config, max_minutes=options.minutes, total_steps=UNLIMITED_STEPS)


def trained(config: TrainingConfig, folder: Path) -> bool:
    """Trains, or continues a training, unless it is complete. Returns whether it is complete now."""
    begun = (folder / "config.yaml").is_file()
    summary = train(run_config(folder) if begun else config, folder if begun else None)
    state = "interrupted" if summary.interrupted else "trained"
    print(f"{folder.name}: {state} after {summary.steps:,} steps in {summary.minutes:.1f} minutes", flush=True)
    return not summary.interrupted


def measured(folder: Path, options: Options) -> dict[str, Any]:
    """Results of a run, from its folder if it has been evaluated before."""
    path = folder / "results.json"
    if not path.is_file():
        write_json(path, _measure(folder, options))
    return json.loads(path.read_text())


ENDLESS = 100.0  # duration of an endless episode, s


def _measure(folder: Path, options: Options) -> dict[str, Any]:
    checkpoint = Checkpoint.load(folder)
    actor, worlds = checkpoint.make_actor(), stored_worlds(checkpoint.env)
    world = worlds[0]
    drive = partial(evaluate, seconds=options.seconds)
    driven = drive(actor, stored_episodes(world).first(options.count), name=folder.name)
    # The original reports the number of goals for inspect only.
    jams = (True, False) if "inspect" in worlds else ()
    goals = endless_episodes("inspect", options.endless)
    endless = {jam: evaluate(actor, goals, name=folder.name, jam=jam, seconds=ENDLESS) for jam in jams}
    write_evaluation(folder / "evaluation.json", [driven, *endless.values()])
    draw_paths([driven], folder / "paths.png")
    quick = min(options.count, FEW_EPISODES)
    others = OTHER_MAZES if world == "maze" else ()
    return {
        "minutes": read_progress(folder / "progress.csv")["minutes"][-1],
        "steps": checkpoint.steps,
        f"steps to {SUCCESS_THRESHOLD:.0%}": _steps_to_enough(folder, stored_episodes(world).first(quick), drive),
        "SR": driven.success_rate,
        "SPL": driven.metrics["spl"].value,
        "MTT, s": driven.metrics["mean_time_to_traverse"].value,
        "turns a goal": driven.metrics["turns_per_goal"].value,
        **{f"failed: {ending}": share for ending, share in _failures(driven.endings).items()},
        **{key: value for jam, evaluation in endless.items() for key, value in _endless(evaluation, jam).items()},
        **{f"SR in {other}": drive(actor, draw_episodes(other, quick)).success_rate for other in others},
    }


def _endless(evaluation: Evaluation, jam: bool) -> dict[str, float]:
    metrics, kind = evaluation.metrics, "" if jam else ", no jam ending"
    names = {"goals in 2,000 steps": "goals_per_episode", "ended early": "ended_early", "turns": "turns_per_goal"}
    return {f"endless{kind}: {name}": metrics[key].value for name, key in names.items()}


def _failures(endings: list[str]) -> dict[str, float]:
    return {kind: endings.count(kind) / len(endings) for kind in sorted(set(endings) - {"goal"})}


def _steps_to_enough(folder: Path, episodes: EpisodeSet, drive: Callable[..., Evaluation]) -> int | None:
    """Number of steps of the first snapshot with a success rate of 90 %; ``None`` if there is none.

    Snapshots are only evaluated if at least half of the training episodes since the last one reached a goal.
    """
    progress, before = read_progress(folder / "progress.csv"), 0
    for path in sorted((folder / "snapshots").glob("*.pt")):
        snapshot = Checkpoint.load(path)
        rows = [row for row, steps in enumerate(progress["steps"]) if before < steps <= snapshot.steps]
        before = snapshot.steps
        ended, reached = (sum(progress[key][row] for row in rows) for key in ("attempts", "attempts_reached"))
        if reached >= ended / 2 and drive(snapshot.make_actor(), episodes).success_rate >= SUCCESS_THRESHOLD:
            return snapshot.steps
    return None


def table(results: dict[str, dict[str, Any]]) -> str:
    """Markdown table with a column for each policy: mean, minimum and maximum over its seeds."""
    policies: dict[str, list[dict[str, Any]]] = {}
    for name, result in results.items():
        policies.setdefault(name.rsplit("-", 1)[0], []).append(result)
    rows = dict.fromkeys(row for result in results.values() for row in result)
    lines = [f"| | {' | '.join(policies)} |", "|---" * (len(policies) + 1) + "|"]
    lines += [f"| {row} | {' | '.join(_cell(row, seeds) for seeds in policies.values())} |" for row in rows]
    return "\n".join(lines) + "\n"


def _cell(row: str, seeds: list[dict[str, Any]]) -> str:
    if not any(row in seed for seed in seeds):
        return ""
    # A seed lists only the failures that occurred.
    values = [seed.get(row, 0.0) for seed in seeds]
    known = [value for value in values if value is not None]
    if not known:
        return "never"
    mean, least, most = map(_format, (statistics.mean(known), min(known), max(known)))
    never = f", {len(values) - len(known)} never" if len(known) < len(values) else ""
    return f"{mean} ({least} to {most}{never})" if len(values) > 1 else mean


def _format(value: float) -> str:
    return f"{value:,.0f}" if value >= 1000 else f"{value:.3g}"


def main(options: Options) -> int:
    folders = []
    for seed in options.seeds:
        for name in options.policies:
            config = settings(name, seed, options)
            folders.append(options.runs / f"{name}-{seed}")
            if not trained(config, folders[-1]):
                return INTERRUPTED
    draw_learning_curve(folders, options.runs / "learning_curves.png")
    found = over_cores(partial(measured, options=options), folders, "measuring")
    results = {folder.name: result for folder, result in zip(folders, found, strict=True)}
    write_json(options.runs / "results.json", results)
    with written_whole(options.runs / "results.md") as temporary:
        temporary.write_text(table(results))
    print(table(results))
    return 0


if __name__ == "__main__":
    raise SystemExit(main(tyro.cli(Options, description=__doc__)))
