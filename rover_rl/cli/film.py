"""``rover-rl film``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from rover_rl.cli.policies import resolve_policy


@dataclass(frozen=True)
class Film:
    """Film a policy that drives: one rover from behind with the beams of its lidar, or many of them from above."""

    policy: tyro.conf.Positional[str]
    """Folder of a run, checkpoint file, pretrained:NAME, scripted or random."""
    out: Path = Path("film.mp4")
    """File to write: .mp4 (needs the extra "video") or .gif."""
    view: Literal["chase", "top"] = "chase"
    """Behind the first rover, or above all of them."""
    world: str | None = None
    """World to drive in; by default the one that the policy was trained in, or maze."""
    seconds: float = 20.0
    """Of driving."""
    seed: int = 0
    """Of starts and goals."""
    rovers: int | None = None
    """Rovers that drive at once; by default 1, or 16 from above."""
    width: int = 640
    """Of the picture, pixels."""
    height: int = 480
    """Of the picture, pixels."""
    fps: int | None = None
    """Pictures a second; by default 20 for .mp4, 10 for .gif."""
    speed: float = 1.0
    """2 shows everything twice as fast as it is."""
    rewards: Path | None = None
    """Draw what the first rover is paid for into this file, such as rewards.png."""

    def __call__(self) -> int:
        """Films, and says where the film is."""
        from rover_rl.algos.evaluation.plots import draw_reward_components
        from rover_rl.algos.video.film import film

        driver = resolve_policy(self.policy, () if self.world is None else (self.world,))
        rollout = film(
            driver.policy,
            self.out,
            world=driver.worlds[0] if driver.worlds else "maze",
            view=self.view,
            seconds=self.seconds,
            seed=self.seed,
            rows={"chase": 1, "top": 16}[self.view] if self.rovers is None else self.rovers,
            width=self.width,
            height=self.height,
            fps=self.fps,
            speed=self.speed,
            lidar_points=driver.lidar_points,
        )
        print(f"Film: {self.out}")
        if self.rewards is not None:
            draw_reward_components(rollout, self.rewards)
            print(f"Rewards: {self.rewards}")
        return 0
