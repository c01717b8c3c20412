"""Panels of a page: live plots, pictures of what the policy sees, bars, and the table of episodes."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping

import numpy as np
import viser
from matplotlib import colormaps
from torch import Tensor
from viser import uplot

from rover_rl.algos.evaluation.plots import BLUE, GREEN, GREY, ORANGE, PURPLE, RED, SKY
from rover_rl.algos.video.recording import Episode
from rover_rl.algos.video.session import VALUE, Session
from rover_rl.envs.sensors.base import Sensor

COLORS = (BLUE, ORANGE, GREEN, PURPLE, RED, SKY, GREY, "#8b5e3c", "#4b5563")  # of the lines of a plot
REWARD = "reward "  # prefix of the records of reward components
PICTURE = 192  # width or height of the picture of an image, pixels, whichever is larger
ACTIONS = ("speed, m/s", "heading, rad")  # names of the parts of an action


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
        if self._handle is not None and tuple(lines) == self._names:
            self._handle.data = data
            return
        if self._handle is not None:
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
        titles = ("speed, m/s", "distance to the goal, m", "reward components", "estimate of the value")
        self._speed, self._distance, self._reward, self._value = (Plot(gui, self._folder, title) for title in titles)

    def show(self, session: Session) -> None:
        history, seen = session.history, session.observation
        steps = len(history.get("speed", ()))
        x = np.arange(-steps + 1, 1) * session.rovers.control_dt
        lines = {name: np.array(values) for name, values in history.items() if len(values) == steps}
        self._speed.show(x, {name: lines[name] for name in ("speed", "speed command") if name in lines})
        self._distance.show(x, {name: lines[name] for name in ("distance",) if name in lines})
        self._value.show(x, {name: lines[name] for name in (VALUE,) if name in lines})
        rewards = {name.removeprefix(REWARD): line for name, line in lines.items() if name.startswith(REWARD)}
        self._reward.show(x, {name: line for name, line in rewards.items() if line.any()})
        if (lidar := seen.get("lidar", None)) is not None:
            self._lidar.content = lidar_picture(lidar[session.row].cpu().numpy(), session.config.lidar.max_range)
        spread = session.action_spread()
        self._spread.content = "" if spread is None else spread_bars(spread)
        self._bars.content = reward_bars({name: line.sum() for name, line in rewards.items()}, session.inside())
        images = {key: sensor for key, sensor in session.rovers.sensors.items() if sensor.image}
        self._show_images({key: sensor_picture(sensor, seen[key][session.row]) for key, sensor in images.items()})

    def _show_images(self, pictures: Mapping[str, np.ndarray]) -> None:
        """Shows what cameras and the like see, pictures ``[height, width, 3]`` by name. Others disappear."""
        for name in self.images.keys() - pictures.keys():
            self.images.pop(name).remove()
        for name, picture in pictures.items():
            if name in self.images:
                self.images[name].image = picture
                continue
            with self._folder:
                self.images[name] = self._gui.add_image(picture, label=name)


def episode_table(episodes: Iterable[Episode]) -> str:
    """A table of episodes in Markdown."""
    head = "| rover | episode | s | goals | ending |\n|--:|--:|--:|--:|:--|"
    rows = (f"| {one.row} | {one.number} | {one.seconds:.1f} | {one.goals} | {one.ending} |" for one in episodes)
    return "\n".join([head, *rows])


def lidar_picture(readings: np.ndarray, max_range: float) -> str:
    """An SVG picture of pooled lidar readings ``[points]`` (m) around the rover, which heads up."""
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
