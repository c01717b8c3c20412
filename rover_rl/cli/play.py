"""The command ``rover-rl play``."""

from __future__ import annotations

import os
import sys
import webbrowser
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from rover_rl.cli.film import how_it_ended
from rover_rl.cli.policies import LOG, ONE_POLICY, resolve_policy

if TYPE_CHECKING:
    from rover_rl.algos.video.recording import Recording

FOLDER = Path("runs/play")
"""Folder of the films of policies that have no folder of their own."""
WIDTH, HEIGHT = 400, 300
"""Size of the films, pixels."""


@dataclass(frozen=True)
class Play:
    """Watch a policy drive to a goal, or a drive of a log: films it, and opens the film.

    ``rover-rl film`` has more options.
    """

    policy: Annotated[
        tyro.conf.Positional[str],
        tyro.conf.arg(metavar="POLICY", help=f"{ONE_POLICY} Or a log of rover-rl drive ({LOG})."),
    ] = "pretrained:anywhere"
    world: str | None = None
    """World to drive in. Default: the one that the policy was trained in, or moon.
    After training in a range, it is one that was not in it."""
    seconds: float = 12.0
    """Time in which the policy must reach the goal, s. Of a log, the last seconds are shown."""
    seed: int | None = None
    """Seed of starts and goals. Default: the stored ones."""
    show: bool = True
    """Open the film in the default viewer, if there is a display."""

    def __call__(self) -> int:
        """Films the drive, prints the path of the film and opens it."""
        print(f"Filming {self.policy}", flush=True)
        with ThreadPoolExecutor(1) as background:
            # The first film compiles the renderer, which takes some seconds, as do the imports.
            background.submit(_compile_renderer)
            import rover_rl.algos.video.film  # noqa: F401
        path, drive = self._film_log() if self.policy.endswith(LOG) else self._film_policy()
        print(f"Film: {path}: {how_it_ended(drive)}")
        if self.show and _has_display():
            webbrowser.open(path.resolve().as_uri())
        return 0

    def _film_log(self) -> tuple[Path, Recording]:
        from rover_rl.algos.video.drive_log import recording_of_log
        from rover_rl.algos.video.film import Style, film_recording

        path, drive = Path(self.policy).with_suffix(".gif"), recording_of_log(Path(self.policy), world=self.world)
        film_recording(drive.last(self.seconds), path, Style(width=WIDTH, height=HEIGHT))
        return path, drive

    def _film_policy(self) -> tuple[Path, Recording]:
        from rover_rl.algos.video.film import CANDIDATES, film_to_goal

        policy = resolve_policy(self.policy, () if self.world is None else (self.world,))
        world = policy.worlds[0] if policy.worlds else "moon"
        path = (policy.folder or FOLDER) / f"{policy.name}-{Path(world).name}.gif".replace(":", "-")
        drive = film_to_goal(
            policy.module, path, world=world, seconds=self.seconds, seed=self.seed, width=WIDTH, height=HEIGHT
        )
        if drive.ending != "goal":
            print(f"From none of {CANDIDATES} starts, a goal was reached within {self.seconds:g} s: this is the first")
        return path, drive


def _compile_renderer() -> None:
    """Compiles the kernels of the renderer, or loads them from the cache of an earlier film."""
    from rover_rl.sims.native.warp import wp
    from rover_rl.sims.rendering.kernels import light, pictures

    for module in (pictures, light):
        wp.load_module(module, device="cpu")


def _has_display() -> bool:
    """Returns whether a window can be opened."""
    return sys.platform in ("darwin", "win32") or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
