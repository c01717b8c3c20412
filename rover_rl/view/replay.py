"""Replays of recorded drives: in one HTML file that opens offline, and on a page. Both have a time slider.

The file holds viser's client and its recording of the scene, so that it shows what the page shows.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
import viser

from rover_rl.algos.video.overlay import caption_of, overlay, stride_of
from rover_rl.algos.video.recording import Moment, Recording, curves_of
from rover_rl.algos.video.session import Pose
from rover_rl.files import written_whole
from rover_rl.progress import ProgressDisplay
from rover_rl.rotations import quaternion_to_euler
from rover_rl.sims.free_space.paths import PathDistances
from rover_rl.view.cameras import LOOK_AT, Cameras
from rover_rl.view.page import HOST, PORT, Page, close_page, open_page
from rover_rl.view.panels import Plot
from rover_rl.view.recorder import Recorder
from rover_rl.view.stage import Stage

FRAMES = 20  # number of updates of the page, 1/s


class Projector:
    """Shows moments of recordings on a page."""

    def __init__(self, server: viser.ViserServer) -> None:
        self.stage, self.cameras = Stage(server), Cameras(server)
        self.recording: Recording | None = None

    def load(self, recording: Recording) -> None:
        """Shows the start of a recording."""
        self.recording = recording
        self.stage.enter(recording.world, recording.robot, recording.ray_angles)
        self.stage.forget_path()
        self.cameras.enter(recording.world)
        self._distances = PathDistances([recording.world], recording.robot)
        self._goal: torch.Tensor | None = None
        self.show(0)

    def show(self, index: int) -> Moment:
        """Shows a moment of the recording and returns it."""
        assert self.recording is not None
        moment = self.recording.moments[index]
        pose = Pose.of(moment.rover)
        self.stage.show(moment, 0, torch.arange(len(moment.goal)), pose)
        self.cameras.follow(pose.position[0].numpy(), quaternion_to_euler(pose.orientation[:1])[0, 2].item())
        if self._goal is None or not moment.goal[0].equal(self._goal):
            self._goal = moment.goal[0]
            self.stage.show_route(self._distances.path(0, pose.position[0, :2], self._goal.cpu()))
        return moment


def write_replay(recordings: Sequence[Recording], path: Path, titles: Sequence[str] | None = None) -> None:
    """Writes recorded drives to an HTML file, one after another, with their ``titles``.

    Raises:
        ImportError: if the extra ``view`` is not installed.
        OSError: if the file cannot be written.
    """
    server = open_page(port=0)
    try:
        projector = Projector(server)
        projector.load(recordings[0])
        server.initial_camera.position, server.initial_camera.look_at = projector.cameras.place(), LOOK_AT
        captions = []
        serializer = server.get_scene_serializer()
        with ProgressDisplay("drawing") as display:
            for number, (recording, title) in enumerate(zip(recordings, titles or [""] * len(recordings), strict=True)):
                if recording is not projector.recording:
                    projector.load(recording)
                stride = stride_of(recording)
                for index in range(0, len(recording.moments), stride):
                    caption = caption_of(projector.show(index))
                    captions.append(f"{title} · {caption}" if title else caption)
                    serializer.insert_sleep(stride * recording.dt)
                    display.update((number + index / len(recording.moments)) / len(recordings))
            page = serializer.as_html()
    finally:
        close_page(server)
    with written_whole(path) as temporary:
        temporary.write_text(page.replace("</body>", f"{overlay(recordings, captions)}</body>"), encoding="utf-8")


class ReplayPage(Page):
    """Page with recorded drives and a time slider.

    Args:
        drives: functions that return the recorded drives, by title. The page calls one when its drive is chosen.
        host, port: as for :class:`~rover_rl.view.Viewer`.
    """

    def __init__(self, drives: Mapping[str, Callable[[], Recording]], host: str = HOST, port: int = PORT) -> None:
        self._drives = drives
        first = next(iter(drives))
        recording = drives[first]()
        super().__init__(host, port)
        self._lock = threading.Lock()
        gui = self.server.gui
        self._status = gui.add_markdown("")
        chosen = gui.add_dropdown("Drive", tuple(drives), initial_value=first)
        chosen.on_update(lambda _: self._choose(chosen.value))
        self._add_play()
        self._time = gui.add_slider("Time, s", 0.0, 1.0, 0.05, 0.0)
        self._time.on_update(lambda event: self._seek(self._time.value) if event.client is not None else None)
        self.projector = Projector(self.server)
        with gui.add_folder("Show", expand_by_default=False):
            self.projector.cameras.add_choice()
            self.projector.stage.add_checkboxes()
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
                plot = self._plots.setdefault(name, Plot(self._folder, name))
                plot.show(self.server, x, {name: values})

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
