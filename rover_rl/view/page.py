"""The page: a viser server on a free port of this machine, with light and sky, and its controls.

Pilot drives by hand with keys and a pad. A key or button that is held sends a message 20 times a second. Without
messages, the rover stops: a page that is closed, hidden or disconnected drives nothing.
"""

from __future__ import annotations

import contextlib
import io
import math
import socket
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

import numpy as np
import viser
from PIL import Image
from torch import Tensor

from rover_rl.algos.video.film import write_film
from rover_rl.envs.actions import find_action
from rover_rl.envs.config import ActionConfig
from rover_rl.sims.rendering.daylight import sky_dome
from rover_rl.sims.rendering.scenery import SUN

if TYPE_CHECKING:
    from typing_extensions import Self

HOST, PORT = "127.0.0.1", 8080  # default address of the page: only this machine reaches it
_PORTS = 65535
_Z_UP = (math.sqrt(0.5), math.sqrt(0.5), 0.0, 0.0)  # turns the light of the sky, which comes from above along y
HOLD_RATE = 20.0  # messages of a held button, 1/s
TIMEOUT = 0.2  # time after the last message of a button from which on it counts as released, s
DIRECTIONS = {"▲": (1.0, 0.0), "◀": (0.0, 1.0), "▼": (-1.0, 0.0), "▶": (0.0, -1.0)}
"""Buttons, and the shares of the top speed forward and of the largest turn to the left that they command."""
SIZE = (540, 960)  # height and width of pictures and films, pixels
RATE = 15  # frames per second of a film
LONGEST = 120.0  # duration of a film at most, s
PATIENCE = 60.0  # time after which a page that draws nothing is gone, s
_KEYS = Path(__file__).with_name("pilot.js")


def open_page(host: str = HOST, port: int = PORT) -> viser.ViserServer:
    """Starts the server of a page with light and sky. Raises ``OSError`` as :func:`check_address` does."""
    port = check_address(host, port)
    with contextlib.redirect_stdout(io.StringIO()):
        # viser prints messages of its own.
        server = viser.ViserServer(host=host, port=port, label="rover_rl", verbose=False)
    server.gui.configure_theme(show_logo=False, show_share_button=False)
    server.gui.main_panel.dock_right()
    server.gui.set_panel_label("rover_rl")
    scene, sky, soil, color = server.scene, (231, 238, 255), (150, 128, 106), (255, 243, 222)
    scene.set_up_direction("+z")
    scene.configure_default_lights(enabled=False)
    scene.configure_environment_map(None)
    scene.add_light_hemisphere("/light/sky", sky_color=sky, ground_color=soil, intensity=1.9, wxyz=_Z_UP)
    # The shadows of what does not move are in the colors of the world. The others are drawn near the middle, where the
    # followed rover is.
    position = tuple(60 * np.array(SUN))
    scene.add_light_directional("/light/sun", color=color, intensity=2.6, position=position, cast_shadow=True)
    scene.add_mesh_trimesh("/light/dome", sky_dome(), cast_shadow=False, receive_shadow=False)
    scene.world_axes.visible = False
    return server


def close_page(server: viser.ViserServer) -> None:
    with contextlib.redirect_stdout(io.StringIO()):
        server.stop()


class Page(ABC):
    """A page that a thread of its own keeps up to date, from :meth:`start` to :meth:`close`. A context manager.

    ``host``, ``port`` and ``address`` are those of :class:`~rover_rl.view.Viewer`.
    """

    def __init__(self, host: str = HOST, port: int = PORT) -> None:
        self.server = open_page(host, port)
        self.address = address_of(self.server.get_host(), self.server.get_port())
        self.playing, self.speed = True, 1.0  # whether what the page shows goes on, and how fast, times real time
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._run, name="page", daemon=True)

    @abstractmethod
    def _run(self) -> None:
        """Updates the page until it is closed."""

    def start(self) -> None:
        self._thread.start()

    def wait(self) -> None:
        """Blocks until the page is closed or the program is interrupted."""
        while not self._closed.wait(0.2):
            pass

    def close(self) -> None:
        """Closes the page. Idempotent."""
        if not self._closed.is_set():
            self._closed.set()
            if self._thread.is_alive():
                self._thread.join(10.0)
            close_page(self.server)

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def play(self, playing: bool) -> None:
        """Lets go on what the page shows, or pauses it."""
        self.playing, self._play.label = playing, "Pause" if playing else "Run"

    def _add_play(self) -> None:
        gui = self.server.gui
        self._play = gui.add_button("Pause", hint="Space")
        self._play.on_click(lambda _: self.play(not self.playing))
        gui.add_command("Pause or run", hotkey="space").on_trigger(lambda _: self.play(not self.playing))
        speed = gui.add_slider("Speed", 0.1, 10.0, 0.1, 1.0, hint="times real time")
        speed.on_update(lambda _: setattr(self, "speed", speed.value))


def address_of(host: str, port: int) -> str:
    return f"http://{'localhost' if host in ('0.0.0.0', HOST) else host}:{port}"


def check_address(host: str, port: int) -> int:
    """Returns a port that is free. Raises ``OSError`` with one sentence if the given one is not."""
    if not 0 <= port <= _PORTS:
        raise ValueError(f"port must be between 0 and {_PORTS}, got {port}")
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, port))
        except OSError as error:
            raise OSError(f"cannot open a page on {host}:{port} ({error.strerror}); choose another --port") from error
        return int(probe.getsockname()[1])


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
