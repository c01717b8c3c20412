"""A training run on a page: its learning curve, and its earlier policies on a slider."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import viser

from rover_rl.algos.experiments.run_files import RunFiles
from rover_rl.algos.policy.checkpoint import Checkpoint
from rover_rl.algos.policy.runner import Policy
from rover_rl.view.panels import Plot


class TrainingPanel:
    """Slider of policies and learning curve of a run.

    Args:
        server: page.
        run: folder of the run.
        choose: function that lets a policy drive, which is called with the function that loads it.
    """

    def __init__(
        self, server: viser.ViserServer, run: RunFiles, choose: Callable[[Callable[[], Policy]], None]
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
