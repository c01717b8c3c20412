"""The page: a viser server on a free port of this machine, with light and sky."""

from __future__ import annotations

import contextlib
import io
import math
import socket
import threading
from abc import ABC, abstractmethod
from typing import TYPE_CHECKING

import numpy as np
import viser

from rover_rl.sims.rendering.daylight import sky_dome
from rover_rl.sims.rendering.scenery import SUN

if TYPE_CHECKING:
    from typing_extensions import Self

HOST, PORT = "127.0.0.1", 8080  # default address of the page: only this machine reaches it
_PORTS = 65535
_Z_UP = (math.sqrt(0.5), math.sqrt(0.5), 0.0, 0.0)  # turns the light of the sky, which comes from above along y


def open_page(host: str = HOST, port: int = PORT) -> viser.ViserServer:
    """Starts the server of a page with light and sky. Raises ``OSError`` as :func:`check_address` does."""
    port = check_address(host, port)
    with contextlib.redirect_stdout(io.StringIO()):
        # viser prints messages of its own.
        server = viser.ViserServer(host=host, port=port, label="rover_rl", verbose=False)
    server.gui.configure_theme(show_logo=False, show_share_button=False)
    server.gui.main_panel.dock_right()
    server.gui.set_panel_label("rover_rl")
    _light(server.scene)
    return server


def close_page(server: viser.ViserServer) -> None:
    with contextlib.redirect_stdout(io.StringIO()):
        server.stop()


class Page(ABC):
    """A page that a thread of its own keeps up to date, from :meth:`start` to :meth:`close`. A context manager.

    Args:
        host: address that the page is served on. ``"0.0.0.0"`` lets other machines reach it.
        port: port of the page; 0 takes a free one.

    Attributes:
        address: address of the page, for a browser on this machine.
        playing: whether what the page shows goes on.
        speed: how fast it goes, times real time.
    """

    def __init__(self, host: str = HOST, port: int = PORT) -> None:
        self.server = open_page(host, port)
        self.address = address_of(self.server.get_host(), self.server.get_port())
        self.playing, self.speed = True, 1.0
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
        """Adds the buttons that pause, and the speed."""
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


def _light(scene: viser.SceneApi) -> None:
    """Adds a sun, the light of the sky and the dome of the sky."""
    scene.set_up_direction("+z")
    scene.configure_default_lights(enabled=False)
    scene.configure_environment_map(None)
    sky, soil = (231, 238, 255), (150, 128, 106)
    scene.add_light_hemisphere("/light/sky", sky_color=sky, ground_color=soil, intensity=1.9, wxyz=_Z_UP)
    # The shadows of what does not move are in the colors of the world. The others are drawn near the middle, where the
    # followed rover is.
    position, color = tuple(60 * np.array(SUN)), (255, 243, 222)
    scene.add_light_directional("/light/sun", color=color, intensity=2.6, position=position, cast_shadow=True)
    scene.add_mesh_trimesh("/light/dome", sky_dome(), cast_shadow=False, receive_shadow=False)
    scene.world_axes.visible = False
