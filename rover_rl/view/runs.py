"""A training run on a page: its learning curve, where its time goes, its own rovers, and its policies on a slider."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TypeAlias

import viser

from rover_rl.algos.experiments.run_files import RunFiles
from rover_rl.algos.policy.checkpoint import CHECKPOINT, Checkpoint
from rover_rl.algos.policy.runner import Policy
from rover_rl.algos.train.progress import TIME
from rover_rl.algos.video.live import LiveMoment, LiveWatch
from rover_rl.algos.video.session import Critic
from rover_rl.view.panels import Plot

Load: TypeAlias = Callable[[], tuple[Policy, Critic | None]]
"""Loads a policy, and its critic if it has one."""


class TrainingPanel:
    """Learning curve, shares of the time, own rovers and slider of policies of a run.

    Args:
        server: page.
        run: folder of the run.
        choose: function that lets a policy drive, which is called with the function that loads it.
    """

    def __init__(self, server: viser.ViserServer, run: RunFiles, choose: Callable[[Load], None]) -> None:
        self._server, self._run, self._choose = server, run, choose
        gui = server.gui
        self._text = gui.add_markdown("")
        hint = "As long as the run trains. Otherwise the rovers of this page drive."
        self._own = gui.add_checkbox("Watch the training's own rovers", True, hint=hint)
        self._watch = LiveWatch(run.folder)
        self._newest = gui.add_checkbox("Always drive with the newest policy", True)
        self._slider = gui.add_slider("Policy", 0, 1, 1, 0, hint="the policies of the run so far, first to last")
        self._slider.on_update(self._on_slide)
        folder = gui.add_folder(None)
        self._plots = {
            name: Plot(folder, title, "steps")
            for name, title in {
                "success rate": "success rate",
                "goals in 2000 steps": "goals",
                TIME: "shares of the time",
            }.items()
        }
        self._seen: tuple[Path, int] | None = None
        self._driver = "Random actions until the run writes its first policy."
        self.refresh()

    def live(self) -> LiveMoment | None:
        """Returns the training's own rovers, if the run trains and the person on the page wants to see them."""
        return self._watch.read() if self._own.value else None

    def drive(self) -> None:
        """Leaves the training's own rovers: from now on, those of the page drive."""
        self._own.value = False

    def refresh(self) -> None:
        """Reads what the run has written since the last call."""
        files = self._run.policies()
        if files and self._seen != (seen := (files[-1], files[-1].stat().st_mtime_ns)):
            self._seen = seen
            self._slider.max = max(1, len(files) - 1)
            if self._newest.value:
                self._slider.value = len(files) - 1
                self._load(files[-1])
        steps, curves = self._run.curves()
        where = f"{int(steps[-1]):,} steps" if len(steps) else "no rows yet"
        self._text.content = f"**{self._run.folder.name}**: {where}, {len(files)} policies. {self._driver}"
        for name, plot in self._plots.items():
            lines = {key.removeprefix(TIME).replace("_", " "): curves[key] for key in curves if key.startswith(name)}
            plot.show(self._server, steps, lines)

    def _on_slide(self, event: viser.GuiEvent) -> None:
        if event.client is None:
            return  # The slider follows the newest policy.
        self._newest.value = False
        self.drive()
        files = self._run.policies()
        if files:
            self._load(files[min(self._slider.value, len(files) - 1)])

    def _load(self, file: Path) -> None:
        self._choose(lambda: self._policy(file))

    def _policy(self, file: Path) -> tuple[Policy, Critic | None]:
        checkpoint = Checkpoint.load(file)
        critic = self._run.critic() if file.name == CHECKPOINT else None
        self._driver = f"The rovers of this page drive with the policy after {checkpoint.steps:,} steps."
        return checkpoint.make_actor(), critic
