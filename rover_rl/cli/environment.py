"""Options of the environment that a policy drives in."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rover_rl.algos.config_files import read_yaml
from rover_rl.envs.config import EnvConfig, env_from_plain

if TYPE_CHECKING:
    from rover_rl.algos.evaluation.evaluate import Policy


@dataclass(frozen=True)
class AnyBackendEnvOptions:
    """Environment to drive in, in a backend that is given apart from it.

    Default: the one that the policy was made for, in Bullet, without randomization.
    """

    env: Path | None = None
    """YAML file of EnvConfig, or a run's config.yaml. Default: the policy's environment in Bullet, not randomized."""
    robot: str | None = None
    """Robot: rover_zero, or module:attribute. Default: that of --env, else of the policy."""
    physics: str | None = None
    """Preset of Bullet's physics: default, accurate or fast (docs/physics.md)."""

    def description(self, policy: Policy | None, backend: str | None = None) -> EnvConfig:
        """Returns the environment for a policy.

        Args:
            policy: the policy; ``None`` acts at random.
            backend: name of the backend; ``None``: that of the file, else Bullet.

        Raises:
            FileNotFoundError: if the file does not exist.
            ValueError: if the file describes no environment, or one that the policy was not made for.
        """
        from rover_rl.algos.evaluation.evaluate import environment_for

        config = environment_for(policy, None if self.env is None else read_env(self.env))
        options = {"robot": self.robot, "backend": backend, "physics": self.physics}
        changes: dict[str, Any] = {key: given for key, given in options.items() if given}
        return environment_for(policy, replace(config, **changes))


@dataclass(frozen=True)
class EnvOptions(AnyBackendEnvOptions):
    """Environment to drive in. Default: the one that the policy was made for, in Bullet, without randomization."""

    backend: str | None = None
    """Simulator: bullet, warp, mujoco (an extra), or module:attribute. Default: that of --env, else bullet."""

    def description(self, policy: Policy | None, backend: str | None = None) -> EnvConfig:
        """Returns the environment for a policy. See :meth:`AnyBackendEnvOptions.description`."""
        return super().description(policy, backend or self.backend)


def read_env(path: Path) -> EnvConfig:
    """Reads the description of an environment from YAML.

    Args:
        path: file with fields of :class:`EnvConfig`, or with settings of a training run, of which ``env`` is used.

    Raises:
        FileNotFoundError: if the file does not exist.
        ValueError: if the file does not describe an environment.
    """
    data = read_yaml(path)
    if isinstance(data, dict) and isinstance(data.get("env"), dict):
        data = data["env"]
    return env_from_plain(data, str(path))
