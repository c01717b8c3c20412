"""A training run on a page: its learning curve, where its time goes, its own rovers, and its policies on a slider."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeAlias

import torch
import viser
from torch import Tensor

from rover_rl.algos.archives import read_archive
from rover_rl.algos.experiments.run_files import RunFiles
from rover_rl.algos.policy.checkpoint import CHECKPOINT, Checkpoint
from rover_rl.algos.policy.runner import Policy
from rover_rl.algos.train import live
from rover_rl.algos.train.progress import TIME
from rover_rl.algos.video.recording import Moment
from rover_rl.algos.video.session import Critic
from rover_rl.sims.rover_state import RoverState
from rover_rl.view.panels import Plot
from rover_rl.worlds import World, get_world
from rover_rl.worlds.movers.parts import Parts

Load: TypeAlias = Callable[[], tuple[Policy, Critic | None]]
"""Loads a policy, and its critic if it has one."""
STALE = 30.0  # age from which on what is written is no longer live, s. Updates of the policy take some seconds


@dataclass(frozen=True)
class LiveMoment:
    """What a training has written: the state of its first rovers, the names of their worlds, and all movers."""

    moment: Moment
    worlds: list[str]
    movers: Parts | None

    def of(self, row: int) -> tuple[World, Moment, Tensor]:
        """World of a rover, the moment with the movers around it, and the rovers in its world."""
        movers = None if self.movers is None else self.movers.of_row(row)
        rows = torch.tensor([one for one, name in enumerate(self.worlds) if name == self.worlds[row]])
        return get_world(self.worlds[row]), replace(self.moment, movers=movers), rows


def watch_training(run: Path) -> LiveMoment | None:
    """Asks the training in the folder of a run for its rovers, and returns what it has written last, if it trains."""
    path = run / live.FOLDER / live.FILE
    try:
        # Without the folder, this fails.
        path.with_name(live.WATCHED).touch()
        if time.time() - path.stat().st_mtime > STALE:
            return None
        data = read_archive(path, live.FORMAT, "file of live rovers")
    except (OSError, ValueError):
        return None
    rover, none = RoverState.pack(**data["rover"]), torch.zeros(len(data["goal"]), dtype=torch.int64)
    moment = Moment(0.0, rover, data["scan"], data["goal"], none, none)
    return LiveMoment(moment, data["worlds"], data["movers"] and Parts(**data["movers"]))


class TrainingPanel:
    """Learning curve, shares of the time, own rovers and slider of policies of a run.

    ``choose`` lets a policy drive: it is called with the function that loads it.
    """

    def __init__(self, gui: viser.GuiApi, run: RunFiles, choose: Callable[[Load], None]) -> None:
        self._run, self._choose = run, choose
        self._text = gui.add_markdown("")
        hint = "As long as the run trains. Otherwise the rovers of this page drive."
        self._own = gui.add_checkbox("Watch the training's own rovers", True, hint=hint)
        self._newest = gui.add_checkbox("Always drive with the newest policy", True)
        self._slider = gui.add_slider("Policy", 0, 1, 1, 0, hint="the policies of the run so far, first to last")
        self._slider.on_update(self._on_slide)
        folder = gui.add_folder(None)
        titles = {"success rate": "success rate", "goals in 2000 steps": "goals", TIME: "shares of the time"}
        self._plots = {name: Plot(gui, folder, title, "steps") for name, title in titles.items()}
        self._seen: tuple[Path, int] | None = None
        self._driver = "Random actions until the run writes its first policy."
        self.refresh()

    def live(self) -> LiveMoment | None:
        """The training's own rovers, if the run trains and the person on the page wants to see them."""
        return watch_training(self._run.folder) if self._own.value else None

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
                self._choose(lambda: self._policy(files[-1]))
        steps, curves = self._run.curves()
        where = f"{int(steps[-1]):,} steps" if len(steps) else "no rows yet"
        self._text.content = f"**{self._run.folder.name}**: {where}, {len(files)} policies. {self._driver}"
        for name, plot in self._plots.items():
            lines = {key.removeprefix(TIME).replace("_", " "): curves[key] for key in curves if key.startswith(name)}
            plot.show(steps, lines)

    def _on_slide(self, event: viser.GuiEvent) -> None:
        if event.client is None:
            return  # The slider follows the newest policy.
        self._newest.value = False
        self.drive()
        if files := self._run.policies():
            file = files[min(self._slider.value, len(files) - 1)]
            self._choose(lambda: self._policy(file))

    def _policy(self, file: Path) -> tuple[Policy, Critic | None]:
        checkpoint = Checkpoint.load(file)
        critic = self._run.critic() if file.name == CHECKPOINT else None
        self._driver = f"The rovers of this page drive with the policy after {checkpoint.steps:,} steps."
        return checkpoint.make_actor(), critic
