"""The page of ``rover-rl train --view``: a process of its own, which reads the files of the run.

Nothing that becomes of the page reaches the training. The page has the lowest priority, so that it takes what time the
training leaves, and it ends with the training, however that ends: then its standard input ends, too.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rover_rl.view.viewer import Viewer

ROVERS = 4
"""Number of rovers on the page, at least."""
LEAST = 19
"""Lowest priority of a process."""


class TrainingPage:
    """Starts and ends the process of the page. A context manager.

    Raises:
        ImportError: if the extra ``view`` is not installed.
        OSError: if the port is taken.
    """

    def __init__(self, host: str, port: int) -> None:
        from rover_rl.view.page import address_of, check_address

        self._host, self._port = host, check_address(host, port)
        self.address = address_of(host, self._port)
        self._process: subprocess.Popen | None = None

    def __enter__(self) -> TrainingPage:
        return self

    def __exit__(self, *_: object) -> None:
        self._end()

    def show(self, folder: Path) -> None:
        """Shows a run in place of the last one."""
        self._end()
        program = [sys.executable, "-m", __name__, str(folder), self._host, str(self._port)]
        self._process = subprocess.Popen(program, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL)

    def _end(self) -> None:
        if self._process is not None:
            self._process.communicate()
            self._process = None


def open_viewer(folder: Path, host: str, port: int) -> Viewer:
    """Opens the page of a run: a few rovers of its own in the environment of the training, with the newest policy."""
    from rover_rl.algos.experiments.run_files import RunFiles
    from rover_rl.envs.make import make_env
    from rover_rl.view.viewer import Viewer

    run = RunFiles(folder)
    trained = run.env
    rows = -(-ROVERS // trained.agents) * trained.agents
    env = make_env(replace(trained, num_envs=rows, device=None))
    return Viewer(env, None, name="newest", host=host, port=port, run=run, background=True)


def main(folder: str, host: str, port: str) -> None:
    """Shows a run until the standard input ends."""
    # Ctrl-C is for the training, which then writes its last files.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if hasattr(os, "nice"):
        os.nice(LEAST)
    threading.Thread(target=_end_with_training, daemon=True).start()
    try:
        viewer = open_viewer(Path(folder), host, int(port))
    except (ValueError, OSError, ImportError, RuntimeError) as error:
        sys.exit(f"rover-rl: the training goes on without a page: {error}")
    viewer.wait()


def _end_with_training() -> None:
    sys.stdin.read()
    # The page has nothing to write, and may still be loading.
    os._exit(0)


if __name__ == "__main__":
    main(*sys.argv[1:])
