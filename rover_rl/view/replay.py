"""Replays of recorded drives: in one HTML file that opens offline, and on a page. Both have a time slider.

The file holds viser's client and its recording of the scene, so that it shows what the page shows, and plots and
captions over it, which follow the slider.
"""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
import viser

from rover_rl.algos.evaluation.plots import BLUE, GREY, RED
from rover_rl.algos.video.recording import Moment, Recording, curves_of
from rover_rl.algos.video.session import Pose
from rover_rl.files import written_whole
from rover_rl.progress import ProgressDisplay
from rover_rl.sims.free_space.paths import PathGrid
from rover_rl.view.page import HOST, PORT, Page, Recorder, close_page, open_page
from rover_rl.view.panels import Plot
from rover_rl.view.stage import LOOK_AT, Stage

FRAMES = 20  # number of updates of the page, 1/s
RATE = 10.0  # largest number of moments in a file, 1/s. Between two, the rovers go on in small steps
_BOX = (
    "position:fixed;left:8px;right:8px;bottom:56px;padding:4px 8px;font:11px sans-serif;"
    "background:rgba(255,255,255,0.8);border-radius:6px;pointer-events:none"
)
_SCRIPT = Path(__file__).with_name("overlay.js")


class Projector:
    """Shows moments of recordings on a page."""

    def __init__(self, server: viser.ViserServer) -> None:
        self.stage = Stage(server)
        self.recording: Recording | None = None

    def load(self, recording: Recording) -> None:
        self.recording, self._grid = recording, PathGrid(recording.world, recording.robot)
        self.stage.enter(recording.world, recording.robot, recording.ray_angles)
        self.stage.forget_path()
        self.show(0)

    def show(self, index: int) -> Moment:
        assert self.recording is not None
        moment = self.recording.moments[index]
        pose = Pose.of(moment.rover)
        rows, ends = torch.arange(len(moment.goal)), (pose.position[0, :2], moment.goal[0].cpu())
        self.stage.show(moment, 0, rows, pose, lambda: self._grid.path(*ends))
        return moment


def write_replay(recordings: Sequence[Recording], path: Path, titles: Sequence[str] | None = None) -> None:
    """Writes recorded drives to an HTML file, one after another, with their ``titles``."""
    server = open_page(port=0)
    try:
        projector = Projector(server)
        projector.load(recordings[0])
        camera = server.initial_camera
        camera.position, camera.look_at = projector.stage.cameras.place(), LOOK_AT
        captions = []
        serializer = server.get_scene_serializer()
        with ProgressDisplay("drawing") as display:
            for number, (recording, title) in enumerate(zip(recordings, titles or [""] * len(recordings), strict=True)):
                if recording is not projector.recording:
                    projector.load(recording)
                for index in range(0, len(recording.moments), stride := _stride(recording)):
                    caption = caption_of(projector.show(index))
                    captions.append(f"{title} · {caption}" if title else caption)
                    serializer.insert_sleep(stride * recording.dt)
                    display.update((number + index / len(recording.moments)) / len(recordings))
            page = serializer.as_html()
    finally:
        close_page(server)
    with written_whole(path) as temporary:
        temporary.write_text(page.replace("</body>", f"{_overlay(recordings, captions)}</body>"), encoding="utf-8")


def caption_of(moment: Moment, row: int = 0) -> str:
    """Time, speed, distance to the goal and recent event of a rover as text."""
    distance = torch.dist(moment.rover.position[row, :2].cpu(), moment.goal[row].cpu()).item()
    # Without the minus of a small negative number that is rounded to zero.
    speed = round(moment.rover.linear_velocity[row].item(), 2) + 0.0
    event, since = moment.event
    recent = f" · {event}" if event and moment.seconds < since + 3 else ""
    return f"{moment.seconds:.1f} s · {speed:.2f} m/s · goal {distance:.1f} m{recent}"


def _stride(recording: Recording) -> int:
    return max(1, round(1 / (RATE * recording.dt)))


def _overlay(recordings: Sequence[Recording], captions: Sequence[str]) -> str:
    """Plots of the drives over the whole time, and captions, which follow the time slider."""
    each = [(curves_of(one), _stride(one)) for one in recordings]
    curves = {name: np.concatenate([curves[name][::stride] for curves, stride in each]) for name in each[0][0]}
    plots = "".join(_curve_plot(name, values) for name, values in curves.items())
    script = f"<script>const captions = {json.dumps(captions)};{_SCRIPT.read_text()}</script>"
    shown = f'<div style="display:flex;gap:12px">{plots}</div>'
    return f'<div style="{_BOX}"><div class="caption" style="font-size:13px"></div>{shown}</div>{script}'


def _curve_plot(name: str, values: np.ndarray) -> str:
    """A plot in SVG, of the class ``curve``, whose horizontal axis goes from 0 to 100 for the first to the last."""
    low, high = min(0.0, float(values.min())), max(float(values.max()), 1e-3)
    x = 100 * np.arange(len(values)) / max(len(values) - 1.0, 1e-9)
    points = zip(x, 38 - 36 * (values - low) / (high - low), strict=True)
    line = " ".join(f"{a:.1f},{b:.1f}" for a, b in points)
    return (
        f'<div style="flex:1"><b>{name}</b> <span style="color:{GREY}">up to {high:.3g}</span>'
        f'<svg class="curve" viewBox="0 0 100 40" preserveAspectRatio="none" style="width:100%;height:44px">'
        f'<polyline points="{line}" fill="none" stroke="{BLUE}" vector-effect="non-scaling-stroke"/>'
        f'<line class="now" y2="40" stroke="{RED}" vector-effect="non-scaling-stroke"/></svg></div>'
    )


class ReplayPage(Page):
    """Page with recorded drives and a time slider.

    ``drives`` are functions that return the recorded drives, by title. The page calls one when its drive is chosen.
    """

    def __init__(self, drives: Mapping[str, Callable[[], Recording]], host: str = HOST, port: int = PORT) -> None:
        self._drives, self._lock = drives, threading.Lock()
        first = next(iter(drives))
        recording = drives[first]()
        super().__init__(host, port)
        gui = self.server.gui
        self._status = gui.add_markdown("")
        chosen = gui.add_dropdown("Drive", tuple(drives), initial_value=first)
        chosen.on_update(lambda _: self._choose(chosen.value))
        self._add_play()
        self._time = gui.add_slider("Time, s", 0.0, 1.0, 0.05, 0.0)
        self._time.on_update(lambda event: self._seek(self._time.value) if event.client is not None else None)
        self.projector = Projector(self.server)
        with gui.add_folder("Show", expand_by_default=False):
            self.projector.stage.add_controls()
            Recorder(gui)
        self._plots: dict[str, Plot] = {}
        self._folder = gui.add_folder(None)
        self._load(recording)
        self.start()

    def _choose(self, title: str) -> None:
        self._status.content = "Loading …"
        try:
            self._load(self._drives[title]())
        except (ValueError, OSError, RuntimeError) as error:
            self._status.content = f"**{title}**: {error}"

    def _load(self, recording: Recording) -> None:
        with self._lock:
            self.recording, self.seconds = recording, 0.0
            self.projector.load(recording)
            self._time.max = max(recording.dt, recording.seconds)
            x = np.arange(len(recording.moments)) * recording.dt
            for name, values in curves_of(recording).items():
                self._plots.setdefault(name, Plot(self.server.gui, self._folder, name)).show(x, {name: values})

    def _seek(self, seconds: float) -> None:
        self.play(False)
        self._show(seconds)

    def _show(self, seconds: float) -> None:
        """Shows the moment at a time, s. At the end, the replay starts again."""
        with self._lock, self.server.atomic():
            self.seconds = seconds if seconds <= self.recording.seconds else 0.0
            index = min(len(self.recording.moments) - 1, round(self.seconds / self.recording.dt))
            moment = self.projector.show(index)
            self._time.value = index * self.recording.dt
            self._status.content = caption_of(moment)

    def _run(self) -> None:
        last = time.monotonic()
        while not self._closed.wait(1 / FRAMES):
            now = time.monotonic()
            if self.playing:
                self._show(self.seconds + (now - last) * self.speed)
            last = now
