"""The command ``rover-rl play``."""

from __future__ import annotations

import os
import sys
import webbrowser
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from rover_rl.cli.policies import ONE_POLICY, resolve_policy

FOLDER = Path("runs/play")
"""Folder of the films of policies that have no folder of their own."""


@dataclass(frozen=True)
class Play:
    """Watch a policy: film a few seconds of its driving, and open the film.

    ``rover-rl film`` has more options.
    """

    policy: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="POLICY", help=ONE_POLICY)] = (
        "pretrained:anywhere"
    )
    world: str | None = None
    """World to drive in. Default: the one that the policy was trained in, or moon.
    After training in a range, it is one that was not in it."""
    seconds: float = 5.0
    """Duration of the drive, s."""
    seed: int = 0
    """Seed of starts and goals."""
    show: bool = True
    """Open the film in the default viewer, if there is a display."""

    def __call__(self) -> int:
        """Films the policy, prints the path of the film and opens it."""
        print(f"Filming {self.seconds:g} s of {self.policy}", flush=True)
        with ThreadPoolExecutor(1) as background:
            # The first film compiles the renderer, which takes some seconds, as do the imports.
            background.submit(_compile_renderer)
            from rover_rl.algos.video.film import film

            policy = resolve_policy(self.policy, () if self.world is None else (self.world,))
        world = policy.worlds[0] if policy.worlds else "moon"
        path = (policy.folder or FOLDER) / f"{policy.name}-{world}.gif".replace(":", "-")
        film(policy.module, path, world=world, seconds=self.seconds, seed=self.seed, width=400, height=300)
        print(f"Film: {path}")
        if self.show and _has_display():
            webbrowser.open(path.resolve().as_uri())
        return 0


def _compile_renderer() -> None:
    """Compiles the kernels of the renderer, or loads them from the cache of an earlier film."""
    from rover_rl.sims.native.warp import wp
    from rover_rl.sims.rendering import kernels

    wp.load_module(kernels, device="cpu")


def _has_display() -> bool:
    """Returns whether a window can be opened."""
    return sys.platform in ("darwin", "win32") or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
