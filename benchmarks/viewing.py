"""Cost of a page: speed of training with and without ``--view``, measured alternately, with a browser on the page.

``python -m benchmarks.viewing``. It needs the extra ``view``, playwright and Chromium. The browser draws in software,
with the lowest priority: it stands for one that draws on a GPU, or on another machine.
"""

from __future__ import annotations

import os
import shutil
import statistics
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import tyro

from rover_rl.algos.train.progress import read_progress
from rover_rl.view.page import check_address

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
def browser_on(address: str) -> Iterator[None]:
    """Opens an address in a headless browser of the lowest priority, once it is served."""
    program = [sys.executable, "-c", _BROWSE, address, str(shutil.which("chromium"))]
    process = subprocess.Popen(program, preexec_fn=lambda: os.nice(19), stdin=subprocess.PIPE)
    try:
        yield
    finally:
        process.communicate()


_BROWSE = """
import sys, time
from playwright.sync_api import Error, sync_playwright
options = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
with sync_playwright() as playwright:
    browser = playwright.chromium.launch(executable_path=sys.argv[2], args=options)
    page = browser.new_page(viewport={"width": 640, "height": 420})
    while True:
        try:
            page.goto(sys.argv[1])
            break
        except Error:
            time.sleep(0.5)
    sys.stdin.read()
"""


def speed_of_training(options: Options, view: bool) -> float:
    """Trains, and returns the steps per second after the start, with a browser on the page if there is one."""
    with TemporaryDirectory() as folder:
        port = check_address("127.0.0.1", 0)
        command = [sys.executable, "-c", "import sys; from rover_rl.cli import main; sys.exit(main())", "train"]
        command += ["--world", options.world, "--max-minutes", str(options.minutes), "--runs", folder, "--name", "run"]
        command += ["--view", "--port", str(port)] if view else []
        training = subprocess.Popen(command, stdout=subprocess.DEVNULL)
        if view:
            with browser_on(f"http://localhost:{port}"):
                training.wait()
        else:
            training.wait()
        columns = read_progress(Path(folder, "run", "progress.csv"))
    first = next(index for index, minutes in enumerate(columns["minutes"]) if minutes > LOAD * options.minutes)
    steps, minutes = (columns[name][-1] - columns[name][first] for name in ("steps", "minutes"))
    return steps / (60 * minutes)


def many_rovers(options: Options) -> tuple[float, float]:
    """Shows many rovers on a page. Returns the seconds that they drive in a second, and the frames per second."""
    from rover_rl import make_env
    from rover_rl.view import Viewer

    viewer = Viewer(make_env(world=options.world, num_envs=options.rovers, backend="warp", seed=0), "scripted", port=0)
    with browser_on(viewer.address):
        deadline = time.monotonic() + 60
        while not viewer.server.get_clients() and time.monotonic() < deadline:
            time.sleep(0.1)
        threading.Event().wait(5.0)
        began, seconds, frames = time.monotonic(), viewer.session.seconds, viewer.frames
        threading.Event().wait(options.seconds)
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
    print(f"median ratio {statistics.median(ratios):.3f}")
    real_time, frames = many_rovers(options)
    print(f"{options.rovers} rovers on a page: {real_time:.2f} times real time, {frames:.1f} frames/s")


if __name__ == "__main__":
    main(tyro.cli(Options))
