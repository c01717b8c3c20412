"""Settings of a run that is continued: which of them may change, and the record of those that did."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rover_rl.algos.config import TrainingConfig
from rover_rl.algos.config_files import plain_settings, read_sessions, run_config, write_config
from rover_rl.algos.policy.checkpoint import SETTINGS

CHANGEABLE = (
    *("total_steps", "max_minutes", "learning_rate", "anneal"),
    *("checkpoint_minutes", "snapshots", "logger", "collector", "workers", "device"),
)
"""Settings that may change when a run is continued: its length, its learning rate, what it saves and what computes."""
_PLACE = ("name", "runs")
"""Settings that say where a run is, which may have been moved."""


@dataclass
class RunRecord:
    """Settings in the ``config.yaml`` of a run, with its sessions that changed some.

    Attributes:
        path: path of the file.
        config: settings of this session.
        sessions: earlier sessions with other settings than the one before: each with ``from_step``, the number of steps
            that the run had, and ``changed``, the new values by name.
        changed: old and new values that this session changes, by name.
    """

    path: Path
    config: TrainingConfig
    sessions: list[dict[str, Any]] = field(default_factory=list)
    changed: dict[str, tuple[Any, Any]] = field(default_factory=dict)

    @classmethod
    def of(cls, folder: Path, config: TrainingConfig) -> RunRecord:
        """Reads the record of a run, which is continued with the settings ``config``.

        Raises:
            FileNotFoundError: if there is no run.
            ValueError: for another value of a setting that may not change.
        """
        before, now = plain_settings(run_config(folder)), plain_settings(config)
        changed = {
            name: (before.get(name), now.get(name))
            for name in dict.fromkeys((*before, *now))
            if name not in _PLACE and before.get(name) != now.get(name)
        }
        if refused := [name for name in changed if name not in CHANGEABLE]:
            trained = ", ".join(f"{name}={changed[name][0]!r}" for name in refused)
            raise ValueError(
                f"{folder} is trained with {trained}, and a run that is continued keeps it (only "
                f"{', '.join(CHANGEABLE)} may change); for a new run that starts from its policy, use --from {folder}"
            )
        return cls(folder / SETTINGS, config, read_sessions(folder / SETTINGS), changed)

    def begin(self) -> None:
        """Writes the settings of a run that has not been trained yet."""
        self.changed = {}
        write_config(self.path, self.config, self.sessions)

    def trained(self, from_step: int) -> None:
        """Writes the settings of this session if they differ from those before, once it has trained.

        Args:
            from_step: number of steps that the run had before this session.
        """
        if self.changed:
            new = {name: value for name, (_, value) in self.changed.items()}
            self.sessions = [*self.sessions, {"from_step": from_step, "changed": new}]
            self.changed = {}
            write_config(self.path, self.config, self.sessions)

    def __str__(self) -> str:
        """What changes, such as ``learning_rate=0.0001 (before: 0.001)``."""
        return ", ".join(f"{name}={new} (before: {old})" for name, (old, new) in self.changed.items())
