"""Plots and captions over a replay in an HTML file, which follow its time slider."""

from __future__ import annotations

import json
from collections.abc import Sequence
from itertools import chain
from pathlib import Path

import numpy as np
import torch

from rover_rl.algos.video.diagrams import curve_plots
from rover_rl.algos.video.recording import Moment, Recording, curves_of

RATE = 10.0  # largest number of moments in a replay, 1/s. Between two, the rovers go on in small steps
_BOX = (
    "position:fixed;left:8px;right:8px;bottom:56px;padding:4px 8px;font:11px sans-serif;"
    "background:rgba(255,255,255,0.8);border-radius:6px;pointer-events:none"
)
_SCRIPT = Path(__file__).with_name("overlay.js")


def stride_of(recording: Recording) -> int:
    return max(1, round(1 / (RATE * recording.dt)))


def overlay(recordings: Sequence[Recording], captions: Sequence[str]) -> str:
    """Returns plots of the drives over the whole time, and captions, which follow the time slider."""
    each = [(curves_of(one), stride_of(one)) for one in recordings]
    names = dict.fromkeys(chain.from_iterable(curves for curves, _ in each))
    curves = {name: np.concatenate([curves[name][::stride] for curves, stride in each]) for name in names}
    x = np.arange(len(next(iter(curves.values()))))
    plots = f'<div style="display:flex;gap:12px">{curve_plots(x, curves)}</div>'
    script = f"<script>const captions = {json.dumps(captions)};{_SCRIPT.read_text()}</script>"
    return f'<div style="{_BOX}"><div class="caption" style="font-size:13px"></div>{plots}</div>{script}'


def caption_of(moment: Moment) -> str:
    """Returns time, speed, distance to the goal and recent event of the first rover as text."""
    distance = torch.dist(moment.rover.position[0, :2].cpu(), moment.goal[0].cpu()).item()
    # Without the minus of a small negative number that is rounded to zero.
    speed = round(moment.rover.linear_velocity[0].item(), 2) + 0.0
    event, since = moment.event
    recent = f" · {event}" if event and moment.seconds < since + 3 else ""
    return f"{moment.seconds:.1f} s · {speed:.2f} m/s · goal {distance:.1f} m{recent}"
