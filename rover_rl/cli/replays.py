"""Drives to replay: those of an evaluation that are worth seeing, and those of a bag."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from rover_rl.algos.policy.names import ResolvedPolicy
from rover_rl.files import check_writable
from rover_rl.progress import ProgressDisplay, redirected_progress

if TYPE_CHECKING:
    from rover_rl.algos.deploy.recorded_drives import Drives
    from rover_rl.algos.evaluation.results import Evaluation, StoredEvaluation
    from rover_rl.algos.video.recording import Recording

DRIVES, DRIVES_EACH = 12, 6  # largest number of drives in a page, and of those of one evaluation
SECONDS = 240.0  # largest duration of all drives in a page together, s. Of a longer drive, the end is shown.


def check_page(path: Path) -> None:
    """Checks the name and the place of a page to write. Raises ``ValueError`` or ``PermissionError``."""
    if path.suffix.lower() not in (".html", ".htm"):
        raise ValueError(f"--html takes a file whose name ends in .html, got {path}")
    check_writable(path, "--html")


def write_worst(evaluations: Sequence[Evaluation], policies: Sequence[ResolvedPolicy], file: Path, page: Path) -> int:
    """Writes a page with the drives of evaluations that went worst, and some that went well. Returns their number.

    The evaluations, which ``file`` holds, share the drives of the page: the more there are, the fewer are of each,
    failures first. ``policies`` are those that drove in them.
    """
    from rover_rl.algos.evaluation.results import read_evaluation
    from rover_rl.algos.video.recording import Recording, record_stored
    from rover_rl.view.replay import write_replay

    modules = {policy.name: policy.module for policy in policies}
    each = min(DRIVES_EACH, max(1, DRIVES // max(1, len(evaluations))))
    chosen = []
    for evaluation in evaluations[:DRIVES]:
        stored = read_evaluation(file, evaluation.name, evaluation.episodes.name, evaluation.backend)
        chosen += [(stored, episode) for episode in stored.telling(each - each // 3, each // 3)]
    drives, titles = list[Recording](), [f"{stored.policy}, {title_of(stored, episode)}" for stored, episode in chosen]
    with ProgressDisplay(f"replay of {len(chosen)} drives") as display:
        for stored, episode in chosen:
            # Half of the work is to drive them again, and half to draw them.
            with redirected_progress(lambda share: display.update((len(drives) + share) / len(chosen) / 2)):
                drive = record_stored(modules[stored.policy], stored, episode)
            drives.append(drive.last(SECONDS / len(chosen)))
        with redirected_progress(lambda share: display.update((1 + share) / 2)):
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

    for episode in dict.fromkeys((*stored.failures, *range(len(stored.endings)))):
        yield title_of(stored, episode), partial(record_stored, policy.module, stored, episode)


def drives_of_bag(bag: Drives) -> Iterator[tuple[str, Callable[[], Recording]]]:
    """Yields the drives of a bag by title, the last one first."""
    from rover_rl.algos.deploy.recorded_drives import recording_of_drive

    for number, drive in reversed([*enumerate(bag.drives)]):
        yield f"drive {number}: {drive.ending}", partial(recording_of_drive, bag, number)
