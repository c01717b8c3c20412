"""``rover-rl train``."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

import tyro

from rover_rl.algos.config import PPOConfig

if TYPE_CHECKING:
    from rover_rl.algos.ppo import TrainingSummary

INTERRUPTED = 130
"""Exit code after Ctrl-C."""


@dataclass(frozen=True)
class Train:
    """Train a policy. Writes checkpoint.pt, config.json, progress.csv, learning_curve.png to a new folder."""

    config: tyro.conf.OmitArgPrefixes[PPOConfig] = field(default_factory=PPOConfig)
    algo: Literal["ppo"] = "ppo"
    """Learning algorithm."""

    def __call__(self) -> int:
        """Trains, and says where the policy is."""
        from rover_rl.algos.plots import draw_learning_curve
        from rover_rl.algos.ppo import train_ppo

        summary = train_ppo(self.config)
        if summary.steps:
            draw_learning_curve(summary.folder / "progress.csv", summary.folder / "learning_curve.png")
        print(f"{told(summary)}\nTry it: rover-rl evaluate {summary.checkpoint}")
        return INTERRUPTED if summary.interrupted else 0


def told(summary: TrainingSummary) -> str:
    """One line on how a training ended."""
    stopped = "Interrupted" if summary.interrupted else "Trained"
    return f"{stopped} after {summary.steps:,} steps in {summary.minutes:.1f} minutes: {summary.checkpoint}"
