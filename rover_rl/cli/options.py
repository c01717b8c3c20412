"""Options that several commands have: policies, the environment that they drive in, a page, and what is written."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeAlias

import tyro

from rover_rl.algos.config_files import read_yaml
from rover_rl.algos.policy.names import BASELINES, NAMES
from rover_rl.envs.config import EnvConfig, GuardConfig, env_from_plain
from rover_rl.robots.options import RobotOptions, with_options
from rover_rl.sims.ros2.settings import BAG

if TYPE_CHECKING:
    from rover_rl.algos.policy.runner import Policy

ONE_POLICY = f"Folder of a run, checkpoint, ONNX file, .zip of Stable-Baselines3, {NAMES}."
"""Help of an argument that names a policy."""
SEVERAL_POLICIES = f"Policies: run folders, checkpoints, ONNX files, .zip of Stable-Baselines3, {NAMES}."
"""Help of an argument that names several policies."""
LIVE_POLICY = f"Policy: run folder, checkpoint, ONNX file, pretrained:NAME, module:attribute, {', '.join(BASELINES)}."
"""Help of an argument that names a policy for a live rover, which does not act at random."""
OptionsOfRobot: TypeAlias = Annotated[
    RobotOptions, tyro.conf.arg(name="robot", help="What a URDF does not tell of the robot.")
]
"""The options of a robot have its prefix: ``--robot scout.urdf --robot.max-speed 2``."""
Force: TypeAlias = Annotated[bool, tyro.conf.arg(help="Write over files that rover-rl did not make.")]
Host: TypeAlias = Annotated[
    str, tyro.conf.arg(help="Address to serve the page on; 0.0.0.0 lets other machines reach it.")
]
Port: TypeAlias = Annotated[int, tyro.conf.arg(help="Port of the page; 0 takes a free one.")]
_WORKERS = "Number of processes. The results do not depend on it. Default: the number of CPU cores."
Workers: TypeAlias = Annotated[int | None, tyro.conf.arg(help=_WORKERS)]
BACKEND = (
    "Simulator: bullet, warp, mujoco (an extra), or module:attribute. Default: that of --env, else bullet, or warp for "
    "several robots."
)
"""Help of an option that names the backend."""


@dataclass(frozen=True)
class EnvOptions:
    """Environment to drive in. Default: the one that the policy was made for, in Bullet, without randomization."""

    env: Path | None = None
    """YAML file of EnvConfig, or a run's config.yaml. Default: the policy's environment in Bullet, not randomized."""
    robot: str | None = None
    """Robot: a name, a URDF file, or module:attribute. Default: that of --env, else of the policy."""
    robot_options: OptionsOfRobot = field(default_factory=RobotOptions)
    physics: str | None = None
    """Preset of the physics: default, accurate or fast of Bullet, full or planar of Warp (docs/simulators.md)."""
    guard: GuardConfig = field(default_factory=GuardConfig)
    """Emergency brake. Default: that of --env."""
    compensate_delay: bool = False
    """Carry late pose, heading and velocities on to now (docs/randomization.md). Default: as --env says, else as in the
    training of the policy."""

    @property
    def given_robot(self) -> str | None:
        """The robot that is named, with its options."""
        return None if self.robot is None else with_options(self.robot, self.robot_options)

    def description(self, policy: Policy | None, backend: str | None, given: EnvConfig | None = None) -> EnvConfig:
        """Returns the environment for a policy, in a backend: that of ``--env``, else a ``given`` one."""
        from rover_rl.algos.evaluation.evaluate import default_backend, environment_for

        given, robot = given if self.env is None else read_env(self.env), self.given_robot
        if given is not None and robot is not None:
            # A policy that was made for this robot does not fit the other one.
            given = replace(given, robot=robot)
        config = environment_for(policy, given)
        options = {"robot": robot, "backend": backend, "physics": self.physics}
        changes: dict[str, Any] = {key: given for key, given in options.items() if given}
        changes["robot_options"] = self.robot_options
        if given is None and backend is None:
            changes["backend"] = default_backend(robot or config.robot)
        if self.guard != GuardConfig():
            changes["guard"] = self.guard
        if self.compensate_delay:
            changes["compensate_delay"] = True
        return environment_for(policy, replace(config, **changes))


def is_bag(word: str) -> bool:
    """Whether an argument names a bag. Raises ``ValueError`` for a log of an older version."""
    if word.endswith(".jsonl"):
        raise ValueError(f"{word} is a log of an older version, which is no longer read: drives are in {BAG} files now")
    return word.endswith((BAG, ".db3")) or (Path(word) / "metadata.yaml").is_file()


def read_env(path: Path) -> EnvConfig:
    """Reads fields of :class:`EnvConfig` from YAML, or from ``env`` in the settings of a training run."""
    data = read_yaml(path)
    if isinstance(data, dict) and isinstance(data.get("env"), dict):
        data = data["env"]
    return env_from_plain(data, str(path))
