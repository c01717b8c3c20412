"""Options of the environment that a policy drives in."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rover_rl.algos.config_files import read_yaml
from rover_rl.envs.config import EnvConfig, env_from_plain

if TYPE_CHECKING:
    from rover_rl.algos.evaluation.evaluate import Policy


BACKEND = "Simulator: bullet, warp, mujoco (an extra), or module:attribute. Default: that of --env, else bullet."
"""Help of an option that names the backend."""


@dataclass(frozen=True)
class EnvOptions:
    """Environment to drive in, in a backend that is given apart from it.

    Default: the one that the policy was made for, in Bullet, without randomization.
    """

    env: Path | None = None
    """YAML file of EnvConfig, or a run's config.yaml. Default: the policy's environment in Bullet, not randomized."""
    robot: str | None = None
    """Robot: rover_zero, or module:attribute. Default: that of --env, else of the policy."""
    physics: str | None = None
    """Preset of Bullet's physics: default, accurate or fast (docs/physics.md)."""

    def description(self, policy: Policy | None, backend: str | None) -> EnvConfig:
        """Returns the environment for a policy."""
        from rover_rl.algos.evaluation.evaluate import environment_for

        config = environment_for(policy, None if self.env is None else read_env(self.env))
        options = {"robot": self.robot, "backend": backend, "physics": self.physics}
        changes: dict[str, Any] = {key: given for key, given in options.items() if given}
        return environment_for(policy, replace(config, **changes))


def read_env(path: Path) -> EnvConfig:
    """Reads the description of an environment from YAML.

    Args:
        path: file with fields of :class:`EnvConfig`, or with settings of a training run, of which ``env`` is used.
    """
    data = read_yaml(path)
    if isinstance(data, dict) and isinstance(data.get("env"), dict):
        data = data["env"]
    return env_from_plain(data, str(path))
