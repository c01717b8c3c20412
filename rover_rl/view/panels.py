"""Panels of a page: live plots, the lidar as the policy sees it, bars and the table of episodes."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np
import viser
from torch import Tensor
from viser import uplot

from rover_rl.algos.evaluation.plots import BLUE, GREEN, GREY, ORANGE, PURPLE, RED, SKY
from rover_rl.algos.video.diagrams import lidar_picture, reward_bars, spread_bars
from rover_rl.algos.video.recording import Episode
from rover_rl.algos.video.session import VALUE

COLORS = (BLUE, ORANGE, GREEN, PURPLE, RED, SKY, GREY, "#8b5e3c", "#4b5563")
"""Colors of the lines of a plot."""
REWARD = "reward "  # prefix of the records of reward components


class Plot:
    """A plot of several lines over a common axis. It appears in ``gui`` when it first has data.

    Args:
        gui: part of the page.
        title: title of the plot.
        axis: name of the common axis.
    """

    def __init__(self, gui: viser.GuiFolderHandle, title: str, axis: str = "s") -> None:
        self._folder, self._title, self._axis = gui, title, axis
        self._handle: viser.GuiUplotHandle | None = None
        self._names: tuple[str, ...] = ()

    def show(self, server: viser.ViserServer, x: np.ndarray, lines: Mapping[str, np.ndarray]) -> None:
        """Shows lines over ``x [n]``. Lines with other names than before make the plot anew."""
        if not lines or len(x) < 2:
            return
        data = (x.astype(np.float64), *(np.asarray(line, dtype=np.float64) for line in lines.values()))
        if self._handle is not None and tuple(lines) == self._names:
            self._handle.data = data
            return
        if self._handle is not None:
            self._handle.remove()
        self._names = tuple(lines)
        series = [uplot.Series(label=name, stroke=COLORS[i % len(COLORS)], width=2) for i, name in enumerate(lines)]
        options = {"title": self._title, "aspect": 1.6, "scales": {"x": uplot.Scale(time=False, auto=True)}}
        with self._folder:
            self._handle = server.gui.add_uplot(data, (uplot.Series(label=self._axis), *series), **options)


class Panels:
    """What goes on inside: plots of the last steps of a rover, its lidar readings and its rewards."""

    def __init__(self, server: viser.ViserServer, folder: viser.GuiFolderHandle) -> None:
        self._server = server
        with folder:
            self._lidar = server.gui.add_html("")
            self._spread = server.gui.add_html("")
            self._bars = server.gui.add_html("")
        self._folder, self._images = folder, dict[str, viser.GuiImageHandle]()
        self._speed, self._distance = Plot(folder, "speed, m/s"), Plot(folder, "distance to the goal, m")
        self._reward, self._value = Plot(folder, "reward components"), Plot(folder, "estimate of the value")

    def show(
        self,
        history: Mapping[str, Sequence[float]],
        dt: float,
        lidar: np.ndarray | None,
        max_range: float,
        inside: Mapping[str, float],
        spread: Tensor | None,
    ) -> None:
        """Shows the records of the last steps, each ``dt`` (s), and the pooled lidar readings ``[points]``, m.

        ``inside`` are numbers without a plot, such as the norm of a recurrent state. ``spread`` is the distribution of
        the action, see :func:`~rover_rl.algos.video.diagrams.spread_bars`; ``None``: the policy has none.
        """
        steps = len(history.get("speed", ()))
        x = np.arange(-steps + 1, 1) * dt
        lines = {name: np.array(values) for name, values in history.items() if len(values) == steps}
        motion = {str(name): lines[name] for name in ("speed", "speed command") if name in lines}
        self._speed.show(self._server, x, motion)
        self._distance.show(self._server, x, {name: lines[name] for name in ("distance",) if name in lines})
        self._value.show(self._server, x, {name: lines[name] for name in (VALUE,) if name in lines})
        rewards = {name.removeprefix(REWARD): line for name, line in lines.items() if name.startswith(REWARD)}
        self._reward.show(self._server, x, {name: line for name, line in rewards.items() if line.any()})
        if lidar is not None:
            self._lidar.content = lidar_picture(lidar, max_range)
        self._spread.content = "" if spread is None else spread_bars(spread)
        self._bars.content = reward_bars({name: line.sum() for name, line in rewards.items()}, inside)

    def show_images(self, pictures: Mapping[str, np.ndarray]) -> None:
        """Shows what cameras and the like see, pictures ``[height, width, 3]`` by name. Others disappear."""
        for name in self._images.keys() - pictures.keys():
            self._images.pop(name).remove()
        for name, picture in pictures.items():
            if name in self._images:
                self._images[name].image = picture
                continue
            with self._folder:
                self._images[name] = self._server.gui.add_image(picture, label=name)


def episode_table(episodes: Iterable[Episode]) -> str:
    """Returns a table of episodes in Markdown."""
    head = "| rover | episode | s | goals | ending |\n|--:|--:|--:|--:|:--|"
    rows = (f"| {one.row} | {one.number} | {one.seconds:.1f} | {one.goals} | {one.ending} |" for one in episodes)
    return "\n".join([head, *rows])
