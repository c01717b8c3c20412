"""Sampled profile of batched steps by function, as a tree and as a flame graph."""

from __future__ import annotations

from typing import Any

from pyinstrument import Profiler
from pyinstrument.renderers import HTMLRenderer
from rich.text import Text

from benchmarks.collecting import make_worker_env
from benchmarks.options import Options
from benchmarks.rollouts import time_rollout
from rover_rl.files import written_whole

INTERVAL = 1e-4
"""Time between two samples of the stack, s."""


def measure(options: Options) -> dict[str, Any]:
    """Profiles rollouts in one process and writes ``breakdown.html``."""
    env = make_worker_env(options.world, options.rovers, 128, 0)
    env.reset()
    with Profiler(interval=INTERVAL) as profiler:
        time_rollout(env, options.seconds)
    env.close()
    with written_whole(options.out / "breakdown.html") as temporary:
        temporary.write_text(profiler.output(HTMLRenderer()))
    return {"rovers": options.rovers, "tree": profiler.output_text(show_all=False, timeline=False)}


def table(result: dict[str, Any]) -> Text:
    """Formats the result for the terminal."""
    return Text(result["tree"])
