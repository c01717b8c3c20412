"""The command ``rover-rl film``."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro

from rover_rl.cli.environment import EnvOptions
from rover_rl.cli.policies import ONE_POLICY, resolve_policy


@dataclass(frozen=True)
class Film:
    """Film a policy: one rover from behind with its lidar beams, or many rovers from above."""

    policy: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="POLICY", help=ONE_POLICY)]
    out: Path = Path("film.mp4")
    """File to write: .mp4 (needs the extra video) or .gif."""
    view: Literal["chase", "top"] = "chase"
    """Camera: chase follows the first rover, top shows all rovers from above."""
    world: str | None = None
    """World to drive in. Default: the one that the policy was trained in, or maze."""
    seconds: float = 20.0
    """Duration of the drive, s."""
    seed: int = 0
    """Seed of starts and goals."""
    rovers: int | None = None
    """Number of rovers. Default: 1 for chase, 16 for top."""
    width: int = 640
    """Width of the video, pixels."""
    height: int = 480
    """Height of the video, pixels."""
    fps: int | None = None
    """Frames per second. Default: 20 for .mp4, 10 for .gif."""
    speed: float = 1.0
    """Playback speed; 2 is twice as fast as real time."""
    rewards: Path | None = None
    """File to plot the first rover's reward components to, such as rewards.png."""
    environment: Annotated[EnvOptions, tyro.conf.arg(name="")] = field(default_factory=EnvOptions)

    def __call__(self) -> int:
        """Films the policy and prints the path of the video."""
        from rover_rl.algos.evaluation.plots import draw_reward_components
        from rover_rl.algos.video.film import film

        policy = resolve_policy(self.policy, () if self.world is None else (self.world,), self.environment.robot)
        rollout = film(
            policy.module,
            self.out,
            world=policy.worlds[0] if policy.worlds else "maze",
            view=self.view,
            seconds=self.seconds,
            seed=self.seed,
            rows={"chase": 1, "top": 16}[self.view] if self.rovers is None else self.rovers,
            width=self.width,
            height=self.height,
            fps=self.fps,
            speed=self.speed,
            env=self.environment.description(policy.module),
        )
        print(f"Film: {self.out}")
        if self.rewards is not None:
            draw_reward_components(rollout, self.rewards)
            print(f"Rewards: {self.rewards}")
        return 0
