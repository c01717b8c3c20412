"""Processes for tests, forked from a server that has imported the package: each starts in a tenth of a second."""

from __future__ import annotations

import multiprocessing
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing.context import BaseContext

PRELOADED = [
    "rover_rl.algos.train.ppo",
    "rover_rl.algos.train.sac",
    "rover_rl.algos.evaluation.evaluate",
    "rover_rl.algos.deploy.driving",
    "rover_rl.cli",
    "rover_rl.sims.bullet",
    "rover_rl.sims.ros2.dds",
    "stable_baselines3",
]
"""Modules that the server imports, those of them that are installed."""


def fork_server() -> BaseContext:
    """Returns the context of a fork server, which starts with the first process."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(PRELOADED)
    return context


@contextmanager
def quick_workers() -> Iterator[None]:
    """Starts TorchRL's workers from the fork server, instead of with a new interpreter each."""
    fork_server()
    before = multiprocessing.get_start_method(allow_none=True)
    multiprocessing.set_start_method("forkserver", force=True)
    try:
        yield
    finally:
        multiprocessing.set_start_method(before, force=True)
