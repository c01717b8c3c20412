"""Work off the clock, such as evaluations of many policies, spread over the cores.

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
    """Does ``work`` with each item, in a process a core, and returns the results in order.

    Args:
        work: a function of a module, or a ``partial`` of one; what it prints is not shown.
        items: that can be pickled, as their results.
        description: shown beside a progress bar on a terminal.
    """
    # Fresh processes, since a fork of one that has run PyTorch's threads can hang; what they need is read once for all.
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["rover_rl.algos.evaluation.evaluate"])
    with ProcessPoolExecutor(min(os.cpu_count() or 1, len(items)) or 1, context, _hush) as pool:
        return list(track(pool.map(work, items), description, len(items), transient=True))


def _hush() -> None:
    """Keeps the progress bars of several processes from being drawn over one another."""
    sys.stdout = open(os.devnull, "w")  # noqa: SIM115
