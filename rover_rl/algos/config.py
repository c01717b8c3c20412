"""Settings of training. Imports no torch, so that the command line can show them at once."""

from __future__ import annotations

import os
from dataclasses import dataclass

SECONDS_PER_STEP = 0.05
"""The simulator is controlled at 20 Hz."""


@dataclass(frozen=True)
class PPOConfig:
    """Settings of PPO. A step is 50 ms of one rover; a decision is one action, for some steps."""

    world: str = "maze"
    """World to train in: inspect, moon or maze; "maze:7" is the maze of seed 7."""
    total_steps: int = 3_000_000
    """Steps to train for, all rovers together."""
    max_minutes: float | None = None
    """Stop after so many minutes, if that comes before total_steps."""
    seed: int = 0
    """Of weights, actions, starts and goals. The same seed gives the same policy, for the same number of
    workers, unless max_minutes decides when to stop."""
    name: str | None = None
    """Name of the run's folder; by default a new one such as ppo-maze."""
    runs: str = "runs"
    """Folder that runs are written into."""
    num_envs: int = 64
    """Rovers that drive at once."""
    workers: int = 1
    """Processes that simulate, each with an equal share of the rovers."""
    repeat: int = 4
    """Steps that each action is held for: 4 lets the policy decide at 5 Hz."""
    episode_steps: int = 2000
    """Steps after which an episode of training is cut short and a new one starts elsewhere."""
    decisions: int = 32
    """Decisions of each rover between two updates."""
    epochs: int = 10
    """Passes over the decisions in an update."""
    minibatch: int = 512
    """Decisions in a gradient step."""
    learning_rate: float = 3e-4
    """At the start; it falls linearly to 0 at the end."""
    gamma: float = 0.96
    """Discount for each decision."""
    lmbda: float = 0.95
    """Of generalized advantage estimation, for each decision."""
    clip: float = 0.2
    """PPO's bound on the change of an action's probability, relative."""
    entropy: float = 0.003
    """Weight of the bonus for acting at random."""
    reward_scale: float = 0.05
    """What the reward is multiplied by before learning."""
    max_grad_norm: float = 1.0
    """Gradients longer than this are shortened to it."""
    hidden: tuple[int, ...] = (128, 128)
    """Units in each hidden layer, of the actor and of the critic."""

    def check(self) -> None:
        """Refuses settings that are out of range.

        Raises:
            ValueError: naming the setting.
        """
        counts = ("total_steps", "num_envs", "workers", "repeat", "episode_steps", "decisions", "epochs", "minibatch")
        for field in counts:
            if getattr(self, field) < 1:
                raise ValueError(f"{field} must be at least 1, got {getattr(self, field)}")
        for field in ("learning_rate", "reward_scale", "max_grad_norm", "clip"):
            if not getattr(self, field) > 0:
                raise ValueError(f"{field} must be positive, got {getattr(self, field)}")
        for field in ("gamma", "lmbda"):
            if not 0 <= getattr(self, field) <= 1:
                raise ValueError(f"{field} must be between 0 and 1, got {getattr(self, field)}")
        if self.entropy < 0:
            raise ValueError(f"entropy must not be negative, got {self.entropy}")
        if self.max_minutes is not None and not self.max_minutes > 0:
            raise ValueError(f"max_minutes must be positive, got {self.max_minutes}")
        if self.num_envs % self.workers:
            raise ValueError(f"num_envs={self.num_envs} rovers cannot be shared equally by workers={self.workers}")
        if not self.hidden or min(self.hidden) < 1:
            raise ValueError(f"hidden must name at least one layer of at least 1 unit, got {self.hidden}")


def default_workers(num_envs: int = PPOConfig.num_envs) -> int:
    """How many workers are fastest here: one for each core, up to 8, that can share the rovers equally."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(workers for workers in range(1, min(cores, 8) + 1) if num_envs % workers == 0)
