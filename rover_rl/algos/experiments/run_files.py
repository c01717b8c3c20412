"""Files of a training run that may still be training: its policies so far, and its learning curves.

A training replaces its files as wholes, so that reading them neither disturbs it nor fails when it is killed.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from tensordict import TensorDictBase

from rover_rl.algos.config import PPOConfig, with_settings
from rover_rl.algos.config_files import run_config
from rover_rl.algos.policy.checkpoint import CHECKPOINT, SETTINGS
from rover_rl.algos.train.ppo import PPOLearner
from rover_rl.algos.train.progress import TIME, read_progress
from rover_rl.algos.train.run_folder import STATE, load_state
from rover_rl.envs.config import EnvConfig

WINDOW = 12
"""Fraction of a run over which its curves are averaged: one in so many."""
POINTS = 400
"""Number of points of a curve at most: a long run has more rows."""


class RunFiles:
    """Folder of a run, which may still be training."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    @classmethod
    def find(cls, path: Path) -> RunFiles | None:
        return cls(path) if (path / SETTINGS).is_file() else None

    @property
    def env(self) -> EnvConfig:
        return run_config(self.folder).env

    def policies(self) -> list[Path]:
        """Returns the files of the policies, first to last: the snapshots, then the checkpoint."""
        last = self.folder / CHECKPOINT
        return [*sorted((self.folder / "snapshots").glob("*.pt")), *([last] if last.is_file() else [])]

    def critic(self) -> Callable[[TensorDictBase], float] | None:
        """Returns the function that estimates the value of an observation ``[1]``, as of the last checkpoint.

        ``None`` if the run has none: before the first checkpoint, with SAC, or if it reads what a policy does not see.
        """
        config, path = run_config(self.folder), self.folder / STATE
        if not isinstance(config.algorithm, PPOConfig) or config.network.privileged_critic or not path.is_file():
            return None
        learner = PPOLearner(with_settings(config, device=None, imitation=0.0))
        learner.load_state_dict(load_state(path)["learner"])
        critic, scale = learner.critic, config.algorithm.reward_scale
        return lambda observation: critic(observation.select(*critic.in_keys))["state_value"].item() / scale

    def curves(self) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        """Returns the steps, ``[points]``, and curves over them; empty before the first row.

        They are the success rate, the goals in 2,000 steps, and the shares of the time, as :data:`TIME` and a name.
        """
        try:
            columns = {key: np.array(values) for key, values in read_progress(self.folder / "progress.csv").items()}
        except (OSError, ValueError):
            columns = {}
        if not columns:
            return np.zeros(0), {}
        width = max(1, len(columns["steps"]) // WINDOW)
        reached, tried = (_sums(columns[key], width) for key in ("attempts_reached", "attempts"))
        goals = _sums(columns["goals_per_2000_steps"], width) / _sums(np.ones(len(reached)), width)
        with np.errstate(invalid="ignore", divide="ignore"):
            success = np.nan_to_num(reached / tried)
        curves = {"success rate": success, "goals in 2000 steps": goals}
        curves |= {name: values for name, values in columns.items() if name.startswith(TIME)}
        # The last row is always among the points.
        shown = slice((len(success) - 1) % (step := -(-len(success) // POINTS)), None, step)
        return columns["steps"][shown], {name: values[shown] for name, values in curves.items()}


def _sums(values: np.ndarray, width: int) -> np.ndarray:
    total = np.concatenate((np.zeros(width), np.cumsum(np.nan_to_num(values))))
    return total[width:] - total[:-width]
