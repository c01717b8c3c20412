"""Parallel evaluation on the CPU cores of this machine.

Example:
    >>> evaluations = over_cores(partial(evaluate, episodes=stored_episodes("maze")), actors, "evaluating")
"""

from __future__ import annotations

import multiprocessing
import os
import sys
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from typing import TypeVar

from rich.progress import track

Item = TypeVar("Item")
Result = TypeVar("Result")


def over_cores(work: Callable[[Item], Result], items: Sequence[Item], description: str) -> list[Result]:
    """Applies ``work`` to each item, with one process per CPU core, and returns the results in order.

    Args:
        work: module-level function, or a ``partial`` of one. Its standard output is discarded.
        items: arguments of ``work``. They and the results must be picklable.
        description: text next to the progress bar on a terminal.
    """
    # Forking a process that has run PyTorch threads can hang. A fork server also imports the modules only once.
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["rover_rl.algos.evaluation.evaluate"])
    with ProcessPoolExecutor(min(os.cpu_count() or 1, len(items)) or 1, context, _silence) as pool:
        return list(track(pool.map(work, items), description, len(items), transient=True))


def _silence() -> None:
    """Discards standard output, so that the progress bars of several processes do not overwrite each other."""
    sys.stdout = open(os.devnull, "w")  # noqa: SIM115
