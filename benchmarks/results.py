"""The README's table and learning curves: trains every policy of the package anew, with several seeds, and measures it.

    python benchmarks/results.py --policies inspect-ppo moon-sac --seeds 0 1 2

Each has the settings that the package's policy was trained with, and the whole machine to itself; when all are trained,
they are measured side by side. Everything is in ``runs/results/``: a run's folder for each, with ``evaluation.json``
and ``paths.png``, and for all of them ``results.md``, ``results.json`` and ``learning_curves.png``. Started anew, it
goes on: a run that is complete is not trained again, and one that was measured is not measured again.
"""

from __future__ import annotations

import json
import statistics
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import tyro

from rover_rl.algos.config import ENDLESS, TrainingConfig, run_config
from rover_rl.algos.evaluation.cores import over_cores
from rover_rl.algos.evaluation.episodes import EpisodeSet, draw_episodes, stored_episodes
from rover_rl.algos.evaluation.evaluate import EndlessEvaluation, Evaluation, evaluate, evaluate_endless
from rover_rl.algos.evaluation.plots import draw_learning_curve, draw_paths
from rover_rl.algos.evaluation.report import write_evaluation
from rover_rl.algos.policy.checkpoint import Checkpoint
from rover_rl.algos.pretrained import load_pretrained, pretrained_names
from rover_rl.algos.train.progress import read_progress
from rover_rl.cli.train import INTERRUPTED, told, train
from rover_rl.files import write_json, written_whole

ENOUGH = 0.9
"""Success that a policy is asked for when it is told how many steps that took."""
OTHER_MAZES = ("maze:1", "maze:2", "maze:3")
"""Which a policy of the maze has never seen."""
QUICK = 128
"""Episodes that are enough for snapshots and for other mazes."""


@dataclass
class Options:
    """What to train and to measure."""

    policies: list[str] = field(default_factory=pretrained_names)
    """Policies of the package to train anew."""
    seeds: list[int] = field(default_factory=lambda: [0, 1, 2])
    """Of weights, actions, starts and goals."""
    minutes: float | None = None
    """Instead of the steps and the time that the package's policies were trained for."""
    count: int = 256
    """Stored episodes to drive."""
    seconds: float = 60.0
    """Time in which a goal has to be reached."""
    endless: int = 32
    """Episodes of 2,000 steps with goals without end to drive, with the jam ending and without."""
    runs: Path = Path("runs/results")
    """Folder to write to."""


def settings(name: str, seed: int, options: Options) -> TrainingConfig:
    """Those of a policy of the package, with another seed."""
    config = load_pretrained(name).config
    config = replace(config, seed=seed, name=f"{name}-{seed}", runs=str(options.runs))
    config = replace(config, workers=None)
    return config if options.minutes is None else replace(config, max_minutes=options.minutes, total_steps=ENDLESS)


def trained(config: TrainingConfig, folder: Path) -> bool:
    """Trains, or goes on with a training, unless it is complete; whether it came to its end."""
    begun = (folder / "config.yaml").is_file()
    summary = train(run_config(folder) if begun else config, folder if begun else None)
    print(f"{folder.name}: {told(summary)}", flush=True)
    return not summary.interrupted


def measured(folder: Path, options: Options) -> dict[str, Any]:
    """What a run came to; kept in its folder."""
    path = folder / "results.json"
    if not path.is_file():
        write_json(path, _measure(folder, options))
    return json.loads(path.read_text())


def _measure(folder: Path, options: Options) -> dict[str, Any]:
    checkpoint = Checkpoint.load(folder)
    actor, world = checkpoint.make_actor(), checkpoint.config.world
    drive = partial(evaluate, seconds=options.seconds)
    driven = drive(actor, stored_episodes(world).first(options.count), name=folder.name)
    # The original tells how many goals it reaches in inspect alone.
    jams = (True, False) if world == "inspect" else ()
    endless = {jam: evaluate_endless(actor, world, name=folder.name, jam=jam, rows=options.endless) for jam in jams}
    write_evaluation(folder / "evaluation.json", [driven, *endless.values()])
    draw_paths([driven], folder / "paths.png")
    quick = min(options.count, QUICK)
    others = OTHER_MAZES if world == "maze" else ()
    return {
        "minutes": read_progress(folder / "progress.csv")["minutes"][-1],
        "steps": checkpoint.steps,
        f"steps to {ENOUGH:.0%}": _steps_to_enough(folder, stored_episodes(world).first(quick), drive),
        "SR": driven.success_rate,
        "SPL": driven.metrics["spl"].value,
        "MTT, s": driven.metrics["mean_time_to_traverse"].value,
        "turns a goal": driven.metrics["turns_per_goal"].value,
        **{f"failed: {ending}": share for ending, share in _failures(driven.endings).items()},
        **{key: value for jam, evaluation in endless.items() for key, value in _endless(evaluation, jam).items()},
        **{f"SR in {other}": drive(actor, draw_episodes(other, quick)).success_rate for other in others},
    }


def _endless(evaluation: EndlessEvaluation, jam: bool) -> dict[str, float]:
    metrics, kind = evaluation.metrics, "" if jam else ", no jam ending"
    names = {"goals in 2,000 steps": "goals_per_episode", "ended early": "ended_early", "turns": "turns_per_goal"}
    return {f"endless{kind}: {name}": metrics[key].value for name, key in names.items()}


def _failures(endings: list[str]) -> dict[str, float]:
    return {kind: endings.count(kind) / len(endings) for kind in sorted(set(endings) - {"goal"})}


def _steps_to_enough(folder: Path, episodes: EpisodeSet, drive: Callable[..., Evaluation]) -> int | None:
    """Steps after which the first snapshot reached 90 %, ``None`` if none did.

    Those from before half of the training's own episodes reached their goal are not driven: it would take long.
    """
    progress, before = read_progress(folder / "progress.csv"), 0
    for path in sorted((folder / "snapshots").glob("*.pt")):
        snapshot = Checkpoint.load(path)
        rows = [row for row, steps in enumerate(progress["steps"]) if before < steps <= snapshot.steps]
        before = snapshot.steps
        ended, reached = (sum(progress[key][row] for row in rows) for key in ("episodes", "episodes_reached"))
        if reached >= ended / 2 and drive(snapshot.make_actor(), episodes).success_rate >= ENOUGH:
            return snapshot.steps
    return None


def table(results: dict[str, dict[str, Any]]) -> str:
    """Markdown: a column a policy, with the mean over its seeds, and the least and the most of them."""
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
    # A kind of failure that a seed does not have is not written down.
    values = [seed.get(row, 0.0) for seed in seeds]
    known = [value for value in values if value is not None]
    if not known:
        return "never"
    mean, least, most = map(_told, (statistics.mean(known), min(known), max(known)))
    never = f", {len(values) - len(known)} never" if len(known) < len(values) else ""
    return f"{mean} ({least} to {most}{never})" if len(values) > 1 else mean


def _told(value: float) -> str:
    return f"{value:,.0f}" if value >= 1000 else f"{value:.3g}"


def main(options: Options) -> int:
    """Trains, measures, and tells."""
    folders = []
    for seed in options.seeds:
        for name in options.policies:
            config = settings(name, seed, options)
            folders.append(options.runs / f"{name}-{seed}")
            if not trained(config, folders[-1]):
                return INTERRUPTED
    draw_learning_curve(folders, options.runs / "learning_curves.png")
    results = dict(
        zip(
            [folder.name for folder in folders],
            over_cores(partial(measured, options=options), folders, "measuring"),
            strict=True,
        )
    )
    write_json(options.runs / "results.json", results)
    with written_whole(options.runs / "results.md") as temporary:
        temporary.write_text(table(results))
    print(table(results))
    return 0


if __name__ == "__main__":
    raise SystemExit(main(tyro.cli(Options, description=__doc__)))
