"""A training run on a page: its learning curve, and its earlier policies on a slider.

The page only reads the files of the run's folder, which a training replaces as wholes. It neither knows nor disturbs
the process that trains.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import viser

from rover_rl.algos.policy.checkpoint import CHECKPOINT, SETTINGS, Checkpoint
from rover_rl.algos.policy.runner import Policy
from rover_rl.algos.train.progress import read_progress
from rover_rl.view.panels import Plot

WINDOW = 12
"""Fraction of a run over which its curves are averaged: one in so many."""


class RunFolder:
    """Folder of a run, which may still be training."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    @classmethod
    def find(cls, path: Path) -> RunFolder | None:
        """Returns the run in a folder, ``None`` if it is no folder of a run."""
        return cls(path) if (path / SETTINGS).is_file() else None

    def policies(self) -> list[Path]:
        """Returns the files of the policies, first to last: the snapshots, then the checkpoint."""
        last = self.folder / CHECKPOINT
        return [*sorted((self.folder / "snapshots").glob("*.pt")), *([last] if last.is_file() else [])]

    def curves(self) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        """Returns the steps, ``[rows]``, and curves over them; empty before the first row."""
        try:
            columns = {key: np.array(values) for key, values in read_progress(self.folder / "progress.csv").items()}
        except (OSError, ValueError):
            columns = {}
        if not columns:
            return np.zeros(0), {}
        width = max(1, len(columns["steps"]) // WINDOW)
        reached, tried = (_sums(columns[key], width) for key in ("attempts_reached", "attempts"))
        goals = _sums(columns["goals_per_2000_steps"], width) / _sums(np.ones(len(reached)), width)
        with np.errstate(invalid="ignore", divide="ignore"):
            success = np.nan_to_num(reached / tried)
        return columns["steps"], {"success rate": success, "goals in 2000 steps": goals}


def _sums(values: np.ndarray, width: int) -> np.ndarray:
    """Returns the sums over the last ``width`` values, ``[rows]``."""
    total = np.concatenate((np.zeros(width), np.cumsum(np.nan_to_num(values))))
    return total[width:] - total[:-width]


class TrainingPanel:
    """Slider of policies and learning curve of a run.

    Args:
        server: page.
        run: folder of the run.
        choose: function that lets a policy drive, which is called with the function that loads it.
    """

    def __init__(
        self, server: viser.ViserServer, run: RunFolder, choose: Callable[[Callable[[], Policy]], None]
    ) -> None:
        self._server, self._run, self._choose = server, run, choose
        gui = server.gui
        self._text = gui.add_markdown("")
        self._newest = gui.add_checkbox("Always drive with the newest policy", True)
        self._slider = gui.add_slider("Snapshot", 0, 1, 1, 0)
        self._slider.on_update(self._on_slide)
        self._folder = gui.add_folder(None)
        self._success, self._goals = (Plot(self._folder, title, "steps") for title in ("success rate", "goals"))
        self._seen: Path | None = None
        self._changed = -1
        self.refresh()

    def refresh(self) -> None:
        """Reads what the run has written since the last call."""
        files = self._run.policies()
        if files and (self._seen, self._changed) != (files[-1], files[-1].stat().st_mtime_ns):
            self._seen, self._changed = files[-1], files[-1].stat().st_mtime_ns
            self._slider.max = max(1, len(files) - 1)
            if self._newest.value:
                self._slider.value = len(files) - 1
                self._load(files[-1])
        steps, curves = self._run.curves()
        where = f"{int(steps[-1]):,} steps" if len(steps) else "no rows yet"
        self._text.content = f"**{self._run.folder.name}**: {where}, {len(files)} policies"
        for plot, name in ((self._success, "success rate"), (self._goals, "goals in 2000 steps")):
            plot.show(self._server, steps, {name: curves[name]} if curves else {})

    def _on_slide(self, event: viser.GuiEvent) -> None:
        if event.client is None:
            return  # The slider follows the newest policy.
        self._newest.value = False
        files = self._run.policies()
        if files:
            self._load(files[min(self._slider.value, len(files) - 1)])

    def _load(self, file: Path) -> None:
        self._choose(lambda: Checkpoint.load(file).make_actor())
