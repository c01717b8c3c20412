"""Some rovers of a training, live, for pages: a file in the folder of the run, written only while somebody watches.

The page touches ``live/watched``, and the training then writes ``live/rovers.pt`` ten times a second. Neither waits for
the other. :mod:`rover_rl.view.panels` reads it.
"""

from __future__ import annotations

import shutil
import time
from contextlib import suppress
from dataclasses import fields
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from torchrl.envs.transforms import Transform

from rover_rl.envs.rover import RoverEnv
from rover_rl.files import written_whole
from rover_rl.worlds.movers.parts import Parts

ROVERS = 4
"""Number of rovers that are written; with groups, at least one group."""
INTERVAL = 0.1
"""Time between two writings, s."""
PATIENCE = 2.0
"""Time after the last sign of a watcher up to which the training writes, s."""
FOLDER, FILE, WATCHED = "live", "rovers.pt", "watched"
"""Folder in that of the run, the file of the rovers in it, and the one that watchers touch."""
FORMAT = "rover_rl-live-1"


class LiveRovers(Transform):
    """Writes the first rovers of an environment for those who watch the run in a folder. Changes no data.

    A file that cannot be written is left out: nothing that becomes of it reaches the training.
    """

    def __init__(self, rovers: RoverEnv, run: Path) -> None:
        super().__init__()
        self._env, self._folder, self._due = rovers, run / FOLDER, 0.0
        self._folder.mkdir(exist_ok=True)
        self._count = min(rovers.num_envs, max(ROVERS, rovers.config.agents))

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        if (now := time.monotonic()) >= self._due:
            self._due = now + INTERVAL
            with suppress(OSError, RuntimeError):
                if time.time() - (self._folder / WATCHED).stat().st_mtime < PATIENCE:
                    self._write()
        return next_tensordict

    def _write(self) -> None:
        env, first = self._env, slice(self._count)
        rover = env.rover_state[first].cpu().to_dict()
        parts = None if env.movers is None else env.movers.parts
        data: dict[str, Any] = {
            "format": FORMAT,
            "rover": {key: value for key, value in rover.items() if value is not None},
            "scan": env.scan[first].cpu(),
            "goal": env.goal[first].cpu(),
            "worlds": [world.name for world in env.worlds[first]],
            "movers": parts and {one.name: getattr(parts, one.name)[first].cpu() for one in fields(Parts)},
        }
        with written_whole(self._folder / FILE) as temporary:
            torch.save(data, temporary)


def forget_live_rovers(run: Path) -> None:
    shutil.rmtree(run / FOLDER, ignore_errors=True)
