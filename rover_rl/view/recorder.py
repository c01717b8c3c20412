"""Recorder: a person on the page saves what it shows, as a picture or a film."""

from __future__ import annotations

import io
import time
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import viser
from PIL import Image

from rover_rl.algos.video.film import write_film

SIZE = (540, 960)  # height and width of pictures and films, pixels
RATE = 15  # frames per second of a film
LONGEST = 120.0  # duration of a film at most, s
TIMEOUT = 60.0  # time after which a page that draws nothing is gone, s


class Recorder:
    """Buttons that save what the camera of the person who presses them sees."""

    def __init__(self, gui: viser.GuiApi) -> None:
        gui.add_button("Save a picture", hint="PNG").on_click(self._save_picture)
        self._button = gui.add_button("Record a film", hint="MP4, or GIF without the extra video")
        self._button.on_click(self._press)
        self._recording = False

    def _save_picture(self, event: viser.GuiEvent) -> None:
        if event.client is not None:
            file = io.BytesIO()
            Image.fromarray(event.client.get_render(*SIZE, timeout=TIMEOUT)).save(file, "PNG")
            event.client.send_file_download("rover.png", file.getvalue(), save_immediately=True)

    def _press(self, event: viser.GuiEvent) -> None:
        """Starts a film, or ends it. viser calls it in a thread of its own."""
        if self._recording or event.client is None:
            self._recording = False
            return
        self._recording, self._button.label = True, "Stop and save the film"
        with TemporaryDirectory() as folder:
            path = Path(folder, "rover.mp4" if find_spec("imageio_ffmpeg") else "rover.gif")
            try:
                write_film(path, self._pictures(event.client), RATE)
                event.client.send_file_download(path.name, path.read_bytes(), save_immediately=True)
            finally:
                self._recording, self._button.label = False, "Record a film"

    def _pictures(self, client: viser.ClientHandle) -> Iterator[np.ndarray]:
        """Yields what the client sees, each picture as often as its time on the screen needs, until the film ends."""
        began = due = time.monotonic()
        while self._recording and due - began < LONGEST:
            picture = client.get_render(*SIZE, timeout=TIMEOUT)
            while due <= time.monotonic():
                yield picture
                due += 1 / RATE
