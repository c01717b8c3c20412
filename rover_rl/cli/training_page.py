"""The page of ``rover-rl train --view``: a process of its own, which reads the files of the run.

Nothing that becomes of the page reaches the training. It loads while the training prepares itself. Once it is open, it
has the lowest priority, so that it takes what time the training leaves. It ends with the training, however that ends:
then its standard input ends, too.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rover_rl.view.viewer import Viewer

LEAST = 19  # lowest priority of a process
_PROGRAM = f"import sys; from {__name__} import main; main(*sys.argv[1:])"


class TrainingPage:
    """Starts and ends the process of the page. A context manager.

    Raises ``ImportError`` if the extra ``view`` is not installed, and ``OSError`` if the port is taken.
    """

    def __init__(self, host: str, port: int) -> None:
        from rover_rl.view.page import address_of, check_address

        self._host, self._port = host, check_address(host, port)
        self.address = address_of(host, self._port)

    def __enter__(self) -> TrainingPage:
        self._start()
        return self

    def __exit__(self, *_: object) -> None:
        self._end()

    def _start(self) -> None:
        program = [sys.executable, "-c", _PROGRAM, self._host, str(self._port)]
        self._process = subprocess.Popen(program, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL)
        self._shown: Path | None = None

    def show(self, folder: Path) -> None:
        """Shows a run, in place of the last one."""
        if self._shown is not None:
            self._end()
            self._start()
        self._shown = folder
        assert self._process.stdin is not None
        # A page that has ended already is none.
        with suppress(OSError):
            self._process.stdin.write(f"{folder}\n".encode())
            self._process.stdin.flush()

    def _end(self) -> None:
        with suppress(OSError):
            self._process.communicate()


def open_viewer(folder: Path, host: str, port: int) -> Viewer:
    """Opens the page of a run: the rovers of the training. A few others can be driven in its environment."""
    from rover_rl.algos.experiments.runs import RunFiles
    from rover_rl.algos.train.live import ROVERS
    from rover_rl.envs.make import make_env
    from rover_rl.view.viewer import Viewer

    run = RunFiles(folder)
    trained = run.env
    rows = -(-ROVERS // trained.agents) * trained.agents
    env = make_env(replace(trained, num_envs=rows, device=None))
    return Viewer(env, None, name="newest", host=host, port=port, run=run)


def main(host: str, port: str) -> None:
    """Shows the run that the standard input names, until it ends."""
    # Ctrl-C is for the training, which then writes its last files.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        import rover_rl.view  # noqa: F401, loads while the training prepares itself

        folder = sys.stdin.readline().rstrip("\n")
        if not folder:
            return  # The training has not begun.
        threading.Thread(target=_end_with_training, daemon=True).start()
        viewer = open_viewer(Path(folder), host, int(port))
    except (ValueError, OSError, ImportError, RuntimeError) as error:
        sys.exit(f"rover-rl: the training goes on without a page: {error}")
    if hasattr(os, "nice"):
        os.nice(LEAST)
    viewer.wait()


def _end_with_training() -> None:
    sys.stdin.read()
    # The page has nothing to write, and may still be loading.
    os._exit(0)
