"""Panels of a page: live plots, what the policy sees, bars, the table of episodes, and a training run."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeAlias

import numpy as np
import torch
import viser
from matplotlib import colormaps
from torch import Tensor
from viser import uplot

from rover_rl.algos.archives import read_archive
from rover_rl.algos.evaluation.plots import BLUE, GREEN, GREY, ORANGE, PURPLE, RED, SKY
from rover_rl.algos.experiments.runs import RunFiles
from rover_rl.algos.policy.checkpoint import CHECKPOINT, Checkpoint
from rover_rl.algos.policy.runner import Policy
from rover_rl.algos.train import live
from rover_rl.algos.train.progress import TIME
from rover_rl.algos.video.recording import Episode, Moment
from rover_rl.algos.video.session import VALUE, Critic, Session
from rover_rl.envs.sensors.base import Sensor
from rover_rl.sims.rover_state import RoverState
from rover_rl.worlds import World, get_world
from rover_rl.worlds.movers.parts import Parts

COLORS = (BLUE, ORANGE, GREEN, PURPLE, RED, SKY, GREY, "#8b5e3c", "#4b5563")  # of the lines of a plot
REWARD = "reward "  # prefix of the records of reward components
PICTURE = 192  # width or height of the picture of an image, pixels, whichever is larger
ACTIONS = ("speed, m/s", "heading, rad")  # names of the parts of an action
Load: TypeAlias = Callable[[], tuple[Policy, Critic | None]]  # loads a policy, and its critic if it has one
STALE = 30.0  # age from which on what is written is no longer live, s. Updates of the policy take some seconds


class Plot:
    """A plot of several lines over a common ``axis``. It appears in the ``folder`` when it first has data."""

    def __init__(self, gui: viser.GuiApi, folder: viser.GuiFolderHandle, title: str, axis: str = "s") -> None:
        self._gui, self._folder, self._title, self._axis = gui, folder, title, axis
        self._handle: viser.GuiUplotHandle | None = None
        self._names: tuple[str, ...] = ()

    def show(self, x: np.ndarray, lines: Mapping[str, np.ndarray]) -> None:
        """Shows lines over ``x [n]``. Lines with other names than before make the plot anew."""
        if not lines or len(x) < 2:
            return
        data = (x.astype(np.float64), *(np.asarray(line, dtype=np.float64) for line in lines.values()))
        if self._handle is not None:
            if tuple(lines) == self._names:
                self._handle.data = data
                return
            self._handle.remove()
        self._names = tuple(lines)
        series = [uplot.Series(label=name, stroke=COLORS[i % len(COLORS)], width=2) for i, name in enumerate(lines)]
        options = {"title": self._title, "aspect": 1.6, "scales": {"x": uplot.Scale(time=False, auto=True)}}
        with self._folder:
            self._handle = self._gui.add_uplot(data, (uplot.Series(label=self._axis), *series), **options)


class Panels:
    """What goes on inside: plots of the last steps of the followed rover, what it sees, and its rewards."""

    def __init__(self, gui: viser.GuiApi) -> None:
        self._gui, self._folder = gui, gui.add_folder(None)
        with self._folder:
            self._lidar, self._spread, self._bars = (gui.add_html("") for _ in range(3))
        self.images: dict[str, viser.GuiImageHandle] = {}
        titles = ("speed, m/s", "distance to the goal, m", "estimate of the value", "reward components")
        *plots, self._reward = (Plot(gui, self._folder, title) for title in titles)
        self._plots = dict(zip(plots, (("speed", "speed command"), ("distance",), (VALUE,)), strict=True))

    def show(self, session: Session) -> None:
        history, seen = session.history, session.observation
        steps = len(history.get("speed", ()))
        x = np.arange(-steps + 1, 1) * session.rovers.control_dt
        lines = {name: np.array(values) for name, values in history.items() if len(values) == steps}
        for plot, names in self._plots.items():
            plot.show(x, {name: lines[name] for name in names if name in lines})
        rewards = {name.removeprefix(REWARD): line for name, line in lines.items() if name.startswith(REWARD)}
        self._reward.show(x, {name: line for name, line in rewards.items() if line.any()})
        if (lidar := seen.get("lidar", None)) is not None:
            self._lidar.content = lidar_picture(lidar[session.row].cpu().numpy(), session.config.lidar.max_range)
        spread = session.action_spread()
        self._spread.content = "" if spread is None else spread_bars(spread)
        self._bars.content = reward_bars({name: line.sum() for name, line in rewards.items()}, session.inside())
        images = {key: sensor for key, sensor in session.rovers.sensors.items() if sensor.image}
        for name in self.images.keys() - images.keys():
            self.images.pop(name).remove()
        for name, sensor in images.items():
            picture = sensor_picture(sensor, seen[name][session.row])
            if name in self.images:
                self.images[name].image = picture
                continue
            with self._folder:
                self.images[name] = self._gui.add_image(picture, label=name)


def episode_table(episodes: Iterable[Episode]) -> str:
    rows = (f"| {one.row} | {one.number} | {one.seconds:.1f} | {one.goals} | {one.ending} |" for one in episodes)
    return "\n".join(["| rover | episode | s | goals | ending |\n|--:|--:|--:|--:|:--|", *rows])


def lidar_picture(readings: np.ndarray, max_range: float) -> str:
    """An SVG picture of pooled lidar readings ``[points]`` (m) around the rover, which heads up."""
    count = len(readings)
    edges = np.linspace(0, 2 * math.pi, count + 1)
    shares = np.sqrt(np.clip(readings, 0, max_range) / max_range) * 95
    wedges = []
    for share, reading, a, b in zip(shares, readings, edges[:-1], edges[1:], strict=True):
        (x0, y0), (x1, y1) = ((-share * math.sin(angle), -share * math.cos(angle)) for angle in (a, b))
        color = RED if reading < 0.5 else ORANGE if reading < 1.5 else SKY
        wedges.append(f'<path d="M0 0L{x0:.1f} {y0:.1f}L{x1:.1f} {y1:.1f}Z" fill="{color}" fill-opacity="0.75"/>')
    return (
        f'<div style="text-align:center;font-size:12px"><svg viewBox="-100 -100 200 200" width="220">'
        f'<circle r="95" fill="#f3f4f6" stroke="{GREY}" stroke-width="0.5"/>{"".join(wedges)}'
        f'<path d="M0 -7L5 6L0 3L-5 6Z" fill="#111827"/></svg><br>'
        f"lidar as the policy sees it: {count} readings up to {max_range:g} m (square-root scale)</div>"
    )


def sensor_picture(sensor: Sensor, value: Tensor) -> np.ndarray:
    """A picture ``[height, width, 3]``, uint8, of the ``value [k]`` of a sensor whose value is an image.

    Dark is low or near, bright is high or far. Colors are shown as they are. Pixels of small images are enlarged.
    """
    assert sensor.image is not None
    low, high = sensor.bounds.tensors(value.device)
    if sensor.features == len(value):
        low, high, value = sensor.encode(low), sensor.encode(high), sensor.encode(value)
    shares = ((value - low) / (high - low)).unflatten(-1, (-1, *sensor.image)).cpu().numpy()
    zoom = max(1, PICTURE // max(sensor.image))
    colors = np.moveaxis(shares, 0, -1) if len(shares) == 3 else colormaps["viridis"](shares[0])[..., :3]
    return (255 * colors).astype(np.uint8).repeat(zoom, 0).repeat(zoom, 1)


def _block(title: str, rows: Iterable[str]) -> str:
    return f'<div style="font-size:12px;padding:4px 12px">{title}{"".join(rows)}</div>'


def reward_bars(rewards: Mapping[str, float], inside: Mapping[str, float]) -> str:
    """Bars of the sums of reward components over the plotted time, and lines of other numbers, in HTML."""
    largest = max((abs(value) for value in rewards.values()), default=0.0) or 1.0
    rows = [
        f'<div style="display:flex;gap:6px"><span style="width:130px">{name}</span>'
        f'<span style="width:70px;text-align:right">{value:.2f}</span><span style="height:10px;margin-top:4px;'
        f'width:{70 * abs(value) / largest:.0f}px;background:{GREEN if value > 0 else RED}"></span></div>'
        for name, value in rewards.items()
        if value
    ]
    rows += [f"<div>{name}: {value:.3g}</div>" for name, value in inside.items()]
    return _block("<b>Reward in the last 30 s</b>" if rewards else "", rows)


def spread_bars(spread: Tensor) -> str:
    """The distribution that each part of an action is drawn from, ``Session.action_spread``, in HTML."""
    rows = []
    for name, (low, below, center, above, high) in zip(ACTIONS, spread.tolist(), strict=False):
        left, middle, right = (100 * (value - low) / (high - low) for value in (below, center, above))
        rows.append(
            f'<div style="display:flex;gap:6px"><span style="width:90px">{name}</span>'
            f'<svg viewBox="0 0 100 10" preserveAspectRatio="none" style="flex:1;height:12px;background:#f3f4f6">'
            f'<rect x="{left:.1f}" width="{right - left:.1f}" height="10" fill="{SKY}"/>'
            f'<rect x="{middle - 0.5:.1f}" width="1" height="10" fill="{BLUE}"/></svg>'
            f'<span style="width:110px">{center:.2f} ({low:.3g} to {high:.3g})</span></div>'
        )
    return _block("<b>Action: center and one standard deviation</b>", rows)


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
