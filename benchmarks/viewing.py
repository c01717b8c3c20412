"""Cost of a page: speed of training with and without ``--view``, measured alternately, with a page open.

``python -m benchmarks.viewing``. It needs the extra ``view``. The page is one on another machine: it gets everything
and draws nothing. A browser on the same machine without a GPU draws on the cores that train.
"""

from __future__ import annotations

import statistics
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import msgspec
import tyro
import viser
from websockets.exceptions import WebSocketException
from websockets.sync.client import connect

from rover_rl.algos.train.progress import read_progress
from rover_rl.view.page import check_address

CAMERA: dict[str, Any] = {
    **{"type": "ViewerCameraMessage", "wxyz": (1.0, 0.0, 0.0, 0.0), "position": (0.0, 0.0, 3.0), "fov": 1.0},
    **{"near": 0.01, "far": 1000.0, "image_height": 480, "image_width": 640, "look_at": (0.0, 0.0, 0.0)},
    "up_direction": (0.0, 0.0, 1.0),
}
"""What a page says first."""
LOAD = 0.4
"""Share of each training after which its speed is measured: the page is open by then."""


@dataclass(frozen=True)
class Options:
    """Measure training with and without a page, and 64 rovers on a page."""

    minutes: float = 1.0
    """Duration of each training, minutes."""
    rounds: int = 3
    """Number of pairs of trainings."""
    world: str = "moon"
    """World."""
    rovers: int = 64
    """Number of rovers on a page."""
    seconds: float = 20.0
    """Duration of the measurement of a page with many rovers, s."""


@contextmanager
def open_page(port: int) -> Iterator[None]:
    """Opens a page, once it is served, which gets all that a browser on another machine gets, and draws nothing."""
    closed = threading.Event()

    def receive() -> None:
        protocol: Any = [f"viser-v{viser.__version__}"]
        while not closed.is_set():
            with (
                suppress(OSError, WebSocketException),
                connect(f"ws://127.0.0.1:{port}", subprotocols=protocol, max_size=None) as page,
            ):
                page.send(msgspec.msgpack.encode(CAMERA))
                while not closed.is_set():
                    with suppress(TimeoutError):
                        page.recv(0.2)
            time.sleep(0.1)

    thread = threading.Thread(target=receive)
    thread.start()
    try:
        yield
    finally:
        closed.set()
        thread.join()


def speed_of_training(options: Options, view: bool) -> float:
    """Trains, and returns the steps per second after the start, with or without an open page."""
    with TemporaryDirectory() as folder:
        port = check_address("127.0.0.1", 0)
        command = [sys.executable, "-c", "import sys; from rover_rl.cli import main; sys.exit(main())", "train"]
        command += ["--world", options.world, "--max-minutes", str(options.minutes), "--runs", folder, "--name", "run"]
        command += ["--view", "--port", str(port)] if view else []
        with open_page(port) if view else nullcontext():
            subprocess.run(command, stdout=subprocess.DEVNULL, check=True)
        columns = read_progress(Path(folder, "run", "progress.csv"))
    first = next(index for index, minutes in enumerate(columns["minutes"]) if minutes > LOAD * options.minutes)
    steps, minutes = (columns[name][-1] - columns[name][first] for name in ("steps", "minutes"))
    return steps / (60 * minutes)


def many_rovers(options: Options) -> tuple[float, float]:
    """Shows many rovers on a page. Returns the seconds that they drive in a second, and the frames per second."""
    from rover_rl import make_env
    from rover_rl.view import Viewer

    viewer = Viewer(make_env(world=options.world, num_envs=options.rovers, backend="warp", seed=0), "scripted", port=0)
    with open_page(viewer.server.get_port()):
        time.sleep(3.0)
        began, seconds, frames = time.monotonic(), viewer.session.seconds, viewer.frames
        time.sleep(options.seconds)
        passed = time.monotonic() - began
        rates = (viewer.session.seconds - seconds) / passed, (viewer.frames - frames) / passed
    viewer.close()
    return rates


def main(options: Options) -> None:
    """Measures, and prints the results."""
    ratios = []
    for _ in range(options.rounds):
        without, viewed = (speed_of_training(options, view) for view in (False, True))
        ratios.append(viewed / without)
        print(f"training: {without:,.0f} steps/s, with a page {viewed:,.0f}: ratio {ratios[-1]:.3f}", flush=True)
    print(f"median ratio {statistics.median(ratios):.3f}", flush=True)
    real_time, frames = many_rovers(options)
    print(f"{options.rovers} rovers on a page: {real_time:.2f} times real time, {frames:.1f} frames/s")


if __name__ == "__main__":
    main(tyro.cli(Options))
