"""Diagrams of what goes on inside of a rover, in HTML and SVG, for pages."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from matplotlib import colormaps
from torch import Tensor

from rover_rl.algos.evaluation.plots import BLUE, GREEN, GREY, ORANGE, RED, SKY
from rover_rl.envs.sensors.base import Sensor

PICTURE = 192
"""Width or height of the picture of an image, pixels, whichever is larger."""
ACTIONS = ("speed, m/s", "heading, rad")
"""Names of the parts of an action."""


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


def sensor_picture(sensor: Sensor, value: Tensor) -> np.ndarray:
    """Returns a picture ``[height, width, 3]``, uint8, of the ``value [k]`` of a sensor whose value is an image.

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


def reward_bars(rewards: Mapping[str, float], inside: Mapping[str, float]) -> str:
    """Returns bars of the sums of reward components over the plotted time, and lines of other numbers, in HTML."""
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


def spread_bars(spread: Tensor) -> str:
    """Returns the distribution that each part of an action is drawn from, in HTML.

    Args:
        spread: lower bound, a standard deviation below the center, center, one above it, and upper bound of each part,
            ``[k, 5]``.
    """
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
    title = "<b>Action: center and one standard deviation</b>"
    return f'<div style="font-size:12px;padding:4px 12px">{title}{"".join(rows)}</div>'


def curve_plots(x: np.ndarray, curves: Mapping[str, np.ndarray]) -> str:
    """Returns a plot of each of some curves over a common axis ``x [n]``, side by side, in SVG.

    The plots are of the class ``curve``. Their horizontal axis goes from 0 to 100 for the first to the last ``x``.
    """
    return "".join(_curve_plot(x, name, values) for name, values in curves.items())


def _curve_plot(x: np.ndarray, name: str, values: np.ndarray) -> str:
    low, high = min(0.0, float(values.min())), max(float(values.max()), 1e-3)
    span = max(float(x[-1] - x[0]), 1e-9)
    points = zip(100 * (x - x[0]) / span, 38 - 36 * (values - low) / (high - low), strict=True)
    line = " ".join(f"{a:.1f},{b:.1f}" for a, b in points)
    return (
        f'<div style="flex:1"><b>{name}</b> <span style="color:{GREY}">up to {high:.3g}</span>'
        f'<svg class="curve" viewBox="0 0 100 40" preserveAspectRatio="none" style="width:100%;height:44px">'
        f'<polyline points="{line}" fill="none" stroke="{BLUE}" vector-effect="non-scaling-stroke"/>'
        f'<line class="now" y2="40" stroke="{RED}" vector-effect="non-scaling-stroke"/></svg></div>'
    )
