"""The command ``rover-rl play``."""

from __future__ import annotations

import os
import sys
import webbrowser
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from rover_rl.algos.policy.names import resolve_policy
from rover_rl.cli.film import POLICY, how_it_ended
from rover_rl.cli.options import Force, is_bag
from rover_rl.files import check_outputs
from rover_rl.sims.ros2.settings import BagTopics

if TYPE_CHECKING:
    from rover_rl.algos.video.recording import Recording

FOLDER = Path("runs/play")  # folder of the films of policies that have no folder of their own
WIDTH, HEIGHT = 400, 300  # size of the films, pixels


@dataclass(frozen=True)
class Play:
    """Watch a policy drive to a goal, or a drive of a bag: films it, and opens the film.

    The command film has more options.
    """

    policy: Annotated[tyro.conf.Positional[str], POLICY] = "pretrained:anywhere"
    world: str | None = None
    """World to drive in. Default: the one that the policy was trained in, or moon.
    After training in a range, it is one that was not in it."""
    seconds: float = 12.0
    """Time in which the policy must reach the goal, s. Of a bag, the last seconds are shown."""
    seed: int | None = None
    """Seed of starts and goals. Default: the stored ones."""
    show: bool = True
    """Open the film in the default viewer, if there is a display."""
    force: Force = False
    topics: BagTopics = field(default_factory=BagTopics)

    def __call__(self) -> int:
        print(f"Filming {self.policy}", flush=True)
        with ThreadPoolExecutor(1) as background:
            # The first film compiles the renderer, which takes some seconds, as do the imports.
            background.submit(_compile_renderer)
            import rover_rl.algos.video.film  # noqa: F401
        path, drive = self._film_bag() if is_bag(self.policy) else self._film_policy()
        print(f"Film: {path}: {how_it_ended(drive)}")
        has_display = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
        if self.show and (has_display or sys.platform in ("darwin", "win32")):
            webbrowser.open(path.resolve().as_uri())
        return 0

    def _film_bag(self) -> tuple[Path, Recording]:
        from rover_rl.algos.deploy.recorded_drives import read_drives, recording_of_drive
        from rover_rl.algos.video.film import Style, film_recording

        path = Path(self.policy).with_suffix(".gif")
        check_outputs(path, force=self.force, option="rover-rl film --out")
        drive = recording_of_drive(read_drives(Path(self.policy), self.topics, self.world))
        film_recording(drive.last(self.seconds), path, Style(width=WIDTH, height=HEIGHT))
        return path, drive

    def _film_policy(self) -> tuple[Path, Recording]:
        from rover_rl.algos.video.film import CANDIDATES, Style, film_to_goal

        policy = resolve_policy(self.policy, () if self.world is None else (self.world,))
        world = policy.worlds[0] if policy.worlds else "moon"
        path = (policy.folder or FOLDER) / f"{policy.name}-{Path(world).name}.gif".replace(":", "-").replace("*", "x")
        check_outputs(path, force=self.force, option="rover-rl film --out")
        style = Style(width=WIDTH, height=HEIGHT)
        drive = film_to_goal(policy.module, path, style, world=world, seconds=self.seconds, seed=self.seed)
        if drive.ending != "goal":
            print(f"From none of {CANDIDATES} starts, a goal was reached within {self.seconds:g} s: this is the first")
        return path, drive


def _compile_renderer() -> None:
    from rover_rl.native.warp import wp
    from rover_rl.sims.rendering import kernels

    wp.load_module(kernels, device="cpu")
