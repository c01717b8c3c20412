"""Cost of a page: speed of training with the page of ``--view`` open and closed, measured alternately in one training.

``python -m benchmarks.viewing``. It needs the extra ``view``. The page is one on another machine: it gets everything
and draws nothing. A browser on the same machine without a GPU draws on the cores that train.
"""

from __future__ import annotations

import os
import statistics
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
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


@dataclass(frozen=True)
class Options:
    """Measure training with and without a page, and 64 rovers on a page."""

    start: float = 20.0
    """Time after the first batch of a training in which its page is loaded, s."""
    rounds: int = 9
    """Number of comparisons."""
    world: str = "moon"
    """World."""
    rovers: int = 64
    """Number of rovers on a page."""
    seconds: float = 6.0
    """Duration of a measurement, s."""


@contextmanager
def open_page(port: int) -> Iterator[None]:
    """Opens a page, once it is served, which gets all that a browser on another machine gets, and draws nothing."""
    closed = threading.Event()

    def receive() -> None:
        # Work of another machine.
        os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), 19)
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


def ratios_of_training(options: Options) -> list[float]:
    """Trains with ``--view``. Opens and closes the page again and again, and returns the ratios of the speeds."""
    with TemporaryDirectory() as folder:
        port = check_address("127.0.0.1", 0)
        command = [sys.executable, "-c", "import sys; from rover_rl.cli import main; sys.exit(main())", "train"]
        # Short batches, so that there are many rows to measure by.
        command += [
            "--world",
            options.world,
            "--rollout-length",
            "4",
            "--num-envs",
            "64",
            "--total-steps",
            "1000000000",
        ]
        command += ["--runs", folder, "--name", "run", "--view", "--port", str(port)]
        training = subprocess.Popen(command, stdout=subprocess.DEVNULL)
        path, ratios = Path(folder, "run", "progress.csv"), []
        try:
            # The page is loaded when it is opened for the first time.
            with open_page(port):
                while not path.is_file() and training.poll() is None:
                    time.sleep(0.5)
                time.sleep(options.start)
            for _ in range(options.rounds):
                without = speed(path, options.seconds)
                with open_page(port):
                    viewed = speed(path, options.seconds)
                ratios.append(2 * viewed / (without + speed(path, options.seconds)))
                print(f"training: {without:,.0f} steps/s, with a page {viewed:,.0f}: {ratios[-1]:.3f}", flush=True)
        finally:
            training.terminate()
            training.wait()
    return ratios


def speed(path: Path, seconds: float) -> float:
    """Returns the steps per second that a training takes in the next seconds."""
    before = after = read_progress(path)
    began = time.monotonic()
    while time.monotonic() < began + seconds or len(after["steps"]) < len(before["steps"]) + 2:
        time.sleep(0.5)
        after = read_progress(path)
    steps, minutes = (after[name][-1] - before[name][-1] for name in ("steps", "minutes"))
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
    ratios = ratios_of_training(options)
    print(f"median ratio {statistics.median(ratios):.3f}", flush=True)
    real_time, frames = many_rovers(options)
    print(f"{options.rovers} rovers on a page: {real_time:.2f} times real time, {frames:.1f} frames/s")


if __name__ == "__main__":
    main(tyro.cli(Options))
