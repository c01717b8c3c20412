"""Panels of a page: live plots, the lidar as the policy sees it, bars and the table of episodes."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence

import numpy as np
import viser
from viser import uplot

from rover_rl.algos.evaluation.plots import BLUE, GREEN, GREY, ORANGE, PURPLE, RED, SKY
from rover_rl.algos.video.session import Episode

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
            self._bars = server.gui.add_html("")
        self._speed, self._distance = Plot(folder, "speed, m/s"), Plot(folder, "distance to the goal, m")
        self._reward = Plot(folder, "reward components")

    def show(
        self,
        history: Mapping[str, Sequence[float]],
        dt: float,
        lidar: np.ndarray | None,
        max_range: float,
        inside: Mapping[str, float],
    ) -> None:
        """Shows the records of the last steps, each ``dt`` (s), and the pooled lidar readings ``[points]``, m.

        ``inside`` are numbers without a plot, such as the norm of a recurrent state.
        """
        steps = len(history.get("speed", ()))
        x = np.arange(-steps + 1, 1) * dt
        lines = {name: np.array(values) for name, values in history.items() if len(values) == steps}
        motion = {str(name): lines[name] for name in ("speed", "speed command") if name in lines}
        self._speed.show(self._server, x, motion)
        self._distance.show(self._server, x, {name: lines[name] for name in ("distance",) if name in lines})
        rewards = {name.removeprefix(REWARD): line for name, line in lines.items() if name.startswith(REWARD)}
        self._reward.show(self._server, x, {name: line for name, line in rewards.items() if line.any()})
        if lidar is not None:
            self._lidar.content = lidar_picture(lidar, max_range)
        self._bars.content = bars({name: line.sum() for name, line in rewards.items()}, inside)


def lidar_picture(readings: np.ndarray, max_range: float) -> str:
    """Returns an SVG picture of pooled lidar readings ``[points]`` (m) around the rover, which heads up."""
    count = len(readings)
    edges = np.arange(count + 1) * (2 * math.pi / count)
    shares = np.sqrt(np.clip(readings, 0, max_range) / max_range) * 95
    wedges = []
    for share, reading, a, b in zip(shares, readings, edges[:-1], edges[1:], strict=True):
        (x0, y0), (x1, y1) = ((-share * math.sin(angle), -share * math.cos(angle)) for angle in (a, b))
        color = RED if reading < 0.5 else ORANGE if reading < 1.5 else SKY
        wedges.append(f'<path d="M0 0L{x0:.1f} {y0:.1f}L{x1:.1f} {y1:.1f}Z" fill="{color}" fill-opacity="0.75"/>')
    ring = f'<circle r="95" fill="#f3f4f6" stroke="{GREY}" stroke-width="0.5"/>'
    rover = '<path d="M0 -7L5 6L0 3L-5 6Z" fill="#111827"/>'
    caption = f"lidar as the policy sees it: {count} readings up to {max_range:g} m (square-root scale)"
    return (
        f'<div style="text-align:center;font-size:12px"><svg viewBox="-100 -100 200 200" width="220">'
        f"{ring}{''.join(wedges)}{rover}</svg><br>{caption}</div>"
    )


def bars(rewards: Mapping[str, float], inside: Mapping[str, float]) -> str:
    """Returns bars of the sums of reward components over the plotted time, and lines of other numbers."""
    largest = max((abs(value) for value in rewards.values()), default=0.0) or 1.0
    rows = [
        f'<div style="display:flex;gap:6px"><span style="width:130px">{name}</span>'
        f'<span style="width:70px;text-align:right">{value:.2f}</span><span style="height:10px;margin-top:4px;'
        f'width:{70 * abs(value) / largest:.0f}px;background:{GREEN if value > 0 else RED}"></span></div>'
        for name, value in rewards.items()
        if value
    ]
    rows += [f"<div>{name}: {value:.3g}</div>" for name, value in inside.items()]
    title = "<b>Reward in the last 30 s</b>" if rewards else ""
    return f'<div style="font-size:12px;padding:4px 12px">{title}{"".join(rows)}</div>'


def episode_table(episodes: Iterable[Episode]) -> str:
    """Returns a table of episodes in Markdown."""
    head = "| rover | episode | s | goals | ending |\n|--:|--:|--:|--:|:--|"
    rows = (f"| {one.row} | {one.number} | {one.seconds:.1f} | {one.goals} | {one.ending} |" for one in episodes)
    return "\n".join([head, *rows])
