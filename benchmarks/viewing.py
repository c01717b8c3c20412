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
import time
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import tyro
from playwright.sync_api import Error, sync_playwright

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


class Browser:
    """A headless browser, which loads a page when it is served. A context manager."""

    def __enter__(self) -> Browser:
        self._playwright = sync_playwright().start()
        options = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
        self._folder = TemporaryDirectory()
        program = Path(self._folder.name, "chromium")
        # A browser of root would take a high priority.
        humble = "setpriv --bounding-set=-sys_nice " if os.geteuid() == 0 else ""
        program.write_text(f'#!/bin/sh\nexec {humble}nice -n 19 {shutil.which("chromium")} "$@"\n')
        program.chmod(0o755)
        self._browser = self._playwright.chromium.launch(executable_path=program, args=options, timeout=300_000)
        self.open("about:blank")
        return self

    def __exit__(self, *_: object) -> None:
        self._browser.close()
        self._playwright.stop()
        self._folder.cleanup()

    def open(self, address: str) -> None:
        """Opens a page in place of the last one."""
        for context in self._browser.contexts:
            context.close()
        page = self._browser.new_page(viewport={"width": 640, "height": 420})
        page.set_default_timeout(120_000)
        while True:
            try:
                page.goto(address)
                return
            except Error:
                time.sleep(0.2)

    def wait(self, seconds: float) -> None:
        """Waits while the page is open."""
        self._browser.contexts[0].pages[0].wait_for_timeout(1000 * seconds)


def speed_of_training(options: Options, browser: Browser | None) -> float:
    """Trains, and returns the steps per second after the start, with a page open in a browser if there is one."""
    with TemporaryDirectory() as folder:
        port = check_address("127.0.0.1", 0)
        command = [sys.executable, "-c", "import sys; from rover_rl.cli import main; sys.exit(main())", "train"]
        command += ["--world", options.world, "--max-minutes", str(options.minutes), "--runs", folder, "--name", "run"]
        command += ["--view", "--port", str(port)] if browser else []
        training = subprocess.Popen(command, stdout=subprocess.DEVNULL)
        if browser:
            browser.open(f"http://localhost:{port}")
            while training.poll() is None:
                browser.wait(0.5)
            browser.open("about:blank")
        training.wait()
        columns = read_progress(Path(folder, "run", "progress.csv"))
    first = next(index for index, minutes in enumerate(columns["minutes"]) if minutes > LOAD * options.minutes)
    steps, minutes = (columns[name][-1] - columns[name][first] for name in ("steps", "minutes"))
    return steps / (60 * minutes)


def many_rovers(options: Options, browser: Browser) -> tuple[float, float]:
    """Shows many rovers on a page. Returns the seconds that they drive in a second, and the frames per second."""
    from rover_rl import make_env
    from rover_rl.view import Viewer

    viewer = Viewer(make_env(world=options.world, num_envs=options.rovers, backend="warp", seed=0), "scripted", port=0)
    browser.open(viewer.address)
    browser.wait(5.0)
    began, seconds, frames = time.monotonic(), viewer.session.seconds, viewer.frames
    browser.wait(options.seconds)
    passed = time.monotonic() - began
    rates = (viewer.session.seconds - seconds) / passed, (viewer.frames - frames) / passed
    viewer.close()
    return rates


def main(options: Options) -> None:
    """Measures, and prints the results."""
    ratios = []
    with Browser() as browser:
        for _ in range(options.rounds):
            without, viewed = (speed_of_training(options, one) for one in (None, browser))
            ratios.append(viewed / without)
            print(f"training: {without:,.0f} steps/s, with a page {viewed:,.0f}: ratio {ratios[-1]:.3f}", flush=True)
        print(f"median ratio {statistics.median(ratios):.3f}", flush=True)
        real_time, frames = many_rovers(options, browser)
    print(f"{options.rovers} rovers on a page: {real_time:.2f} times real time, {frames:.1f} frames/s")


if __name__ == "__main__":
    main(tyro.cli(Options))
