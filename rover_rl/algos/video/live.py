"""Moments of a training: what :mod:`rover_rl.algos.train.live` writes, for pages that watch."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

from rover_rl.algos.archives import read_archive
from rover_rl.algos.train.live import FILE, FOLDER, FORMAT, WATCHED
from rover_rl.algos.video.recording import Moment
from rover_rl.sims.rover_state import RoverState
from rover_rl.worlds import World, get_world
from rover_rl.worlds.movers.parts import Parts

STALE = 30.0
"""Age from which on what is written is no longer live, s. Updates of the policy take some seconds."""


@dataclass(frozen=True)
class LiveMoment:
    """What a training has written: the state of its first rovers, the names of their worlds, and all movers."""

    moment: Moment
    worlds: list[str]
    movers: Parts | None

    def of(self, row: int) -> tuple[World, Moment, Tensor]:
        movers = None if self.movers is None else self.movers.of_row(row)
        rows = torch.tensor([one for one, name in enumerate(self.worlds) if name == self.worlds[row]])
        return get_world(self.worlds[row]), replace(self.moment, movers=movers), rows


class LiveWatch:
    """Watches the rovers of the training in the folder of a run."""

    def __init__(self, run: Path) -> None:
        self._folder = run / FOLDER

    def read(self) -> LiveMoment | None:
        """Asks for the rovers, and returns what was written last; ``None`` if the run is not training."""
        path = self._folder / FILE
        try:
            # Without the folder, this fails.
            (self._folder / WATCHED).touch()
            if time.time() - path.stat().st_mtime > STALE:
                return None
            data = read_archive(path, FORMAT, "file of live rovers")
        except (OSError, ValueError):
            return None
        rover, none = RoverState.pack(**data["rover"]), torch.zeros(len(data["goal"]), dtype=torch.int64)
        moment = Moment(0.0, rover, data["scan"], data["goal"], none, none)
        return LiveMoment(moment, data["worlds"], data["movers"] and Parts(**data["movers"]))
