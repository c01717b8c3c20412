"""Checkpoint: a trained policy with its settings and the environment that it was made for."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from torch import Tensor
from torchrl.modules import ProbabilisticActor

from rover_rl.algos.archives import first_not_finite, read_archive, write_archive
from rover_rl.algos.config import TrainingConfig
from rover_rl.algos.config_files import config_from, plain
from rover_rl.algos.policy.networks import actor_of
from rover_rl.envs.config import EnvConfig, RobotLike, require_match
from rover_rl.files import written_whole
from rover_rl.tensordicts import with_torch_defaults

SETTINGS, CHECKPOINT = "config.yaml", "checkpoint.pt"
"""Names of the files in a run's folder that hold the settings and the policy."""
_FORMAT = "rover_rl checkpoint, version 4"


@dataclass(frozen=True)
class Checkpoint:
    """A trained policy: its weights, its settings, and the number of steps of all rovers together in training."""

    config: TrainingConfig
    steps: int
    actor: dict[str, Tensor]

    @property
    def env(self) -> EnvConfig:
        return self.config.env

    def for_robot(self, robot: RobotLike) -> Checkpoint:
        """Returns the policy with the settings of one robot. Raises ``ValueError`` if it was made for another one."""
        env = replace(self.env, robot=robot)
        require_match(self.env, env)
        return replace(self, config=replace(self.config, env=env))

    def save(self, path: Path) -> None:
        """Writes the checkpoint atomically."""
        with written_whole(path) as temporary:
            self.write(temporary)

    def write(self, path: Path) -> None:
        write_archive(path, _FORMAT, {"config": plain(self.config), "steps": self.steps, "actor": self.actor})

    @classmethod
    def load(cls, path: str | Path) -> Checkpoint:
        """Loads a checkpoint from a file or a run's folder. No code in the file is executed.

        Raises ``FileNotFoundError``, and ``ValueError`` for a file that is damaged or whose weights are not finite.
        """
        path = Path(path)
        path = path / CHECKPOINT if path.is_dir() else path
        if path.name == CHECKPOINT and not path.exists():
            reason = f"the run has written none yet; if it has ended, go on with rover-rl train --resume {path.parent}"
            if not (path.parent / SETTINGS).is_file():
                reason = f"{path.parent} is not the folder of a run"
            raise FileNotFoundError(f"no checkpoint at {path}: {reason}")
        data = read_archive(path, _FORMAT, "checkpoint")
        try:
            config = config_from(data.pop("config"), str(path))
            checkpoint = cls(config=config, **data)
            not_finite = first_not_finite(checkpoint.actor)
        except (AttributeError, KeyError, TypeError) as error:
            raise ValueError(f"{path} is a damaged checkpoint: {error}") from error
        if not_finite is not None:
            raise ValueError(f"{path} holds NaN or infinity in the policy's weights {not_finite}: it cannot drive")
        return checkpoint

    @with_torch_defaults
    def make_actor(self) -> ProbabilisticActor:
        """Makes the policy, a TorchRL module. Raises ``ValueError`` if the weights do not fit the settings.

        Its attributes say which environment it was ``made_for``, and the number of steps that each action was held for
        in training: ``trained_action_repeat``.
        """
        network, actor = self.config.network, actor_of(self.config)
        try:
            actor.load_state_dict(self.actor)
        except RuntimeError as error:
            memory = "" if network.memory == "none" else f", memory={network.memory!r} of {network.memory_size} units"
            raise ValueError(f"the checkpoint's weights do not fit hidden={network.hidden}{memory}") from error
        # Evaluation and deployment compare it with the environment to drive in.
        actor.made_for = self.env
        actor.trained_action_repeat = self.config.collection.action_repeat
        return actor
