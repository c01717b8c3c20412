"""Drives to replay: those of an evaluation that are worth seeing, and those of a log."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from rover_rl.cli.policies import ResolvedPolicy

if TYPE_CHECKING:
    from rover_rl.algos.evaluation.results import Evaluation
    from rover_rl.algos.evaluation.stored import StoredEvaluation
    from rover_rl.algos.video.recording import Recording

WORST, GOOD = 4, 2
"""Number of drives of each evaluation in a page that went worst, and that went as usual."""


def write_worst(evaluations: Sequence[Evaluation], policies: Sequence[ResolvedPolicy], file: Path, page: Path) -> int:
    """Writes a page with the drives of evaluations that went worst, and some that went well. Returns their number.

    Args:
        evaluations: evaluations of the policies.
        policies: policies, by whose name the evaluations are found.
        file: ``evaluation.json`` that holds the evaluations.
        page: HTML file to write.
    """
    from rover_rl.algos.evaluation.stored import read_evaluation
    from rover_rl.algos.video.recording import record_stored
    from rover_rl.view.replay import write_replay

    modules = {policy.name: policy.module for policy in policies}
    drives, titles = [], []
    for evaluation in evaluations:
        stored = read_evaluation(file, evaluation.name, evaluation.episodes.name, evaluation.backend)
        for episode in stored.telling(WORST, GOOD):
            drives.append(record_stored(modules[stored.policy], stored, episode))
            titles.append(f"{stored.policy}, {title_of(stored, episode)}")
    write_replay(drives, page, titles)
    return len(drives)


def title_of(stored: StoredEvaluation, episode: int) -> str:
    """Returns a title of an episode of an evaluation, such as ``episode 7 in maze: jammed after 12.3 s``."""
    ending = "goal reached" if stored.endings[episode] == "goal" else stored.endings[episode]
    world = stored.episodes.worlds[episode].name
    return f"episode {episode} in {world}: {ending} after {stored.durations[episode]:.1f} s"


def drives_of_evaluation(
    policy: ResolvedPolicy, stored: StoredEvaluation
) -> Iterator[tuple[str, Callable[[], Recording]]]:
    """Yields the episodes of an evaluation by title, the failures first, as functions that drive them again."""
    from rover_rl.algos.video.recording import record_stored

    failed = stored.failures
    for episode in dict.fromkeys((*failed, *range(len(stored.endings)))):
        yield title_of(stored, episode), partial(record_stored, policy.module, stored, episode)


def drives_of_log(path: Path, world: str | None) -> Iterator[tuple[str, Callable[[], Recording]]]:
    """Yields the drives of a log by title, the last one first."""
    from rover_rl.algos.deploy.drive_log import logged_drives
    from rover_rl.algos.video.recording import recording_of_log

    for number, drive in reversed([*enumerate(logged_drives(path))]):
        yield f"drive {number}: {drive.ending}", partial(recording_of_log, path, number, world)
