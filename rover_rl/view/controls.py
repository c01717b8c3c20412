"""Controls of a page: driving by hand with keys and a pad, and saving pictures and films.

A key or button that is held sends a message 20 times a second. Without messages, the rover stops: a page that is
closed, hidden or disconnected drives nothing.
"""

from __future__ import annotations

import io
import math
import time
from collections.abc import Callable, Iterator
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import viser
from PIL import Image
from torch import Tensor

from rover_rl.algos.video.film import write_film
from rover_rl.envs.actions import find_action
from rover_rl.envs.config import ActionConfig

HOLD_RATE = 20.0  # messages of a held button, 1/s
TIMEOUT = 0.2  # time after the last message of a button from which on it counts as released, s
DIRECTIONS = {"▲": (1.0, 0.0), "◀": (0.0, 1.0), "▼": (-1.0, 0.0), "▶": (0.0, -1.0)}
"""Buttons, and the shares of the top speed forward and of the largest turn to the left that they command."""
SIZE = (540, 960)  # height and width of pictures and films, pixels
RATE = 15  # frames per second of a film
LONGEST = 120.0  # duration of a film at most, s
PATIENCE = 60.0  # time after which a page that draws nothing is gone, s
_KEYS = Path(__file__).with_name("pilot.js")


class Pilot:
    """Commands of a person on the page, who may take over from the policy (``active``). Adds the pad to a page."""

    def __init__(self, gui: viser.GuiApi) -> None:
        self._pressed = dict.fromkeys(DIRECTIONS, -math.inf)
        self.active = False
        gui.add_markdown("**By hand**: hold W A S D, the arrows or these buttons. Let go, and the rover stops.")
        for label, hint in zip(DIRECTIONS, ("W or ↑", "A or ←", "S or ↓", "D or →"), strict=True):
            button = gui.add_button(label, hint=f"Drive by hand while held: {hint}")
            button.on_hold(self._presser(label), callback_hz=HOLD_RATE)
        self._wheel = gui.add_button("Take over", color="orange")
        self._wheel.on_click(lambda _: self.give_back() if self.active else self.take_over())
        script = _KEYS.read_text().partition("\n")[2].replace('"', "&quot;")
        gui.add_html(f'<img src="data:," style="display:none" onerror="{script}">')

    def _presser(self, label: str) -> Callable:
        # A coroutine runs in the loop of the server, which no other callback can hold up.
        async def press(_: object) -> None:
            self._pressed[label] = time.monotonic()
            if not self.active:
                self.take_over()

        return press

    def take_over(self) -> None:
        """Lets the person drive. The rover stands as long as nothing is pressed."""
        self.active, self._wheel.label = True, "Give back to the policy"

    def give_back(self) -> None:
        self.active, self._wheel.label = False, "Take over"

    def command(self) -> tuple[float, float]:
        """Shares of the top speed forward and of the largest turn to the left, -1 to 1 each."""
        now = time.monotonic()
        held = [DIRECTIONS[label] for label, pressed in self._pressed.items() if now - pressed < TIMEOUT]
        speed, turn = (sum(part) for part in zip((0.0, 0.0), *held, strict=True))
        return max(-1.0, min(1.0, speed)), max(-1.0, min(1.0, turn))

    def steered(self, action: Tensor, row: int, limits: ActionConfig) -> Tensor:
        """The actions ``[N, A]``, of which that of ``row`` is the person's if one has taken over."""
        if not self.active:
            return action
        steered = action.clone()
        steered[row] = action.new_tensor(find_action(limits.kind).by_hand(limits, *self.command()))
        return steered


class Recorder:
    """Buttons that save what the camera of the person who presses them sees, as a picture or a film."""

    def __init__(self, gui: viser.GuiApi) -> None:
        gui.add_button("Save a picture", hint="PNG").on_click(self._save_picture)
        self._button = gui.add_button("Record a film", hint="MP4, or GIF without the extra video")
        self._button.on_click(self._press)
        self._recording = False

    def _save_picture(self, event: viser.GuiEvent) -> None:
        if event.client is not None:
            file = io.BytesIO()
            Image.fromarray(event.client.get_render(*SIZE, timeout=PATIENCE)).save(file, "PNG")
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
            picture = client.get_render(*SIZE, timeout=PATIENCE)
            while due <= time.monotonic():
                yield picture
                due += 1 / RATE
