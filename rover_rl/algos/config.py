"""Settings of training, and their YAML files. Imports no torch, so that the command line can show them at once."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from types import UnionType
from typing import Any, ClassVar, Literal, TypeAlias, TypeVar, get_args, get_origin, get_type_hints

import yaml

from rover_rl.checks import MAX_COUNT, MAX_NUMBER, MAX_ROVERS, check_at_least, check_positive, check_seed
from rover_rl.files import write_through, written_whole

SECONDS_PER_STEP = 0.05
"""The simulator is controlled at 20 Hz."""
OBSERVATION_KEYS = ("lidar", "imu", "target", "velocities", "pose")
"""Entries of an observation that a policy can read."""
Backend: TypeAlias = Literal["bullet", "warp", "ray"]
"""What can make the rollouts of a training."""
Physics: TypeAlias = Literal["default", "accurate", "fast"]
"""Presets of the physics: :data:`rover_rl.sims.bullet.settings.PRESETS`, which needs PyTorch."""
ENDLESS = 10**9
"""Steps that no training comes to: its time ends it."""
_COUNTED_ON = 2**32
"""Seeds that a training may count on from its own: one for each rover, at another place each time it is resumed."""


@dataclass(frozen=True)
class TrainingConfig:
    """Settings of every algorithm. A step is 50 ms of one rover; a decision is one action, for some steps."""

    algo: ClassVar[str]
    """Name of the algorithm."""
    asynchronous: ClassVar[bool]
    """Whether it learns while other processes go on driving, since it may learn from what older policies did."""

    world: str | tuple[str, ...] = "moon"
    """World to train in: inspect, moon or maze; "maze:7" is the maze of seed 7. Of several, each gets an equal share of
    the rovers."""
    total_steps: int = 600_000
    """Steps to train for, all rovers together; a decision counts as repeat steps."""
    max_minutes: float | None = None
    """Stop after so many minutes, if that comes before total_steps."""
    seed: int = 0
    """Of weights, actions, starts and goals. With --workers 1 the same seed gives the same policy to the last bit,
    unless max_minutes decides when to stop."""
    name: str | None = None
    """Name of the run's folder; by default a new one such as ppo-maze."""
    runs: str = "runs"
    """Folder that runs are written into."""
    checkpoint_minutes: float = 1.0
    """Minutes between two checkpoints, from which --resume goes on."""
    snapshots: int = 20
    """Policies that are kept from along the way, evenly spaced, to see later how fast it learned."""
    num_envs: int = 64
    """Rovers that drive at once."""
    backend: Backend = "bullet"
    """What makes the rollouts: Bullet in processes of this machine; Warp in threads of this one, about twenty times as
    fast (extra warp); or Bullet on the machines of a Ray cluster (the one that RAY_ADDRESS names or that runs here,
    else a new one on this machine; extra ray)."""
    device: str = "cpu"
    """Where rovers drive and networks learn: cpu, or with Warp cuda, or cuda:1 for the second GPU."""
    physics: Physics = "default"
    """Preset of Bullet's physics: see docs/physics.md."""
    randomize: bool = False
    """Vary friction, mass, motors, latency and sensors from rover to rover and from episode to episode, as much as
    those of a real one may be off (docs/warp.md): for policies that are to leave the simulator."""
    workers: int | None = None
    """Processes that simulate, each with an equal share of the rovers; by default as many as there are cores, or the
    most below that which share the rovers equally, and 1 for Warp."""
    repeat: int = 4
    """Steps that each action is held for in training: 4 lets the policy decide at 5 Hz."""
    episode_steps: int = 600
    """Steps after which an episode of training is cut short and a new one starts elsewhere."""
    observation: tuple[str, ...] = ("lidar", "imu", "target", "velocities")
    """What the policy reads. With "pose" it may learn its way about one map, which is of no use on another."""
    north_up: bool = False
    """Let the policy also see lidar and target as on a map, turned by the IMU's yaw. It can recognise the places of one
    map by it without knowing its pose. Needs mirror off."""
    hidden: tuple[int, ...] = (128, 128)
    """Units in each hidden layer, of the actor and of the critic."""
    reverse: bool = True
    """Let the policy drive backwards, too. It is quicker so where it can see around what stands in its way; before the
    walls of a maze it comes to go to and fro."""
    spread: float = 2.0
    """Largest standard deviation of an action, before it is squashed to its bounds. Much of it finds good ways fast;
    less (0.6) keeps the policy from relying on chance to get out of a corner, which it then has not when it drives."""
    gamma: float = 0.96
    """Discount for each decision."""
    learning_rate: float = 1e-3
    """Of Adam."""
    anneal: bool = True
    """Let the learning rate fall linearly to 0 at the end."""
    path_reward: float = 0.0
    """In training, pay this much on top of the contract's reward for each metre gained on the shortest free way to the
    goal. It leads around the walls of a maze; 0 is the contract's reward alone."""
    reward_scale: float = 0.05
    """What the reward is multiplied by before learning."""
    max_grad_norm: float = 1.0
    """Gradients longer than this are shortened to it."""
    mirror: bool = True
    """Learn from each decision or, at even odds, from its mirror image: left and right are alike."""

    @property
    def worlds(self) -> tuple[str, ...]:
        """Names of the worlds to train in."""
        return (self.world,) if isinstance(self.world, str) else self.world

    @property
    def processes(self) -> int:
        """Processes that simulate."""
        return self.workers or default_workers(self.num_envs, 1 if self.backend == "warp" else None)

    @property
    def on_gpu(self) -> bool:
        """Whether the training is on a GPU."""
        return self.device != "cpu"

    @property
    def rovers_each(self) -> int:
        """Rovers of each process."""
        return self.num_envs // self.processes

    def check(self) -> None:
        """Refuses settings that are out of range.

        Raises:
            ValueError: naming the setting.
        """
        self._require_counts("total_steps", "repeat", "episode_steps")
        check_at_least(1, MAX_ROVERS, num_envs=self.num_envs)
        check_seed(self.seed, _COUNTED_ON)
        if self.workers is not None:
            self._require_counts("workers")
        self._require_positive("learning_rate", "reward_scale", "max_grad_norm", "checkpoint_minutes", "spread")
        self._require_share("gamma")
        check_at_least(0, MAX_COUNT, snapshots=self.snapshots)
        check_at_least(0, MAX_NUMBER, path_reward=self.path_reward)
        if self.max_minutes is not None:
            self._require_positive("max_minutes")
        if self.num_envs % self.processes:
            raise ValueError(f"num_envs={self.num_envs} rovers cannot be shared equally by workers={self.workers}")
        if not 1 <= len(self.worlds) <= self.rovers_each:
            raise ValueError(
                f"world must name at least one world, and no more than the {self.rovers_each} rovers of a worker: "
                f"got {self.world}"
            )
        for name, allowed in (("backend", get_args(Backend)), ("physics", get_args(Physics))):
            if getattr(self, name) not in allowed:
                raise ValueError(f"{name} must be one of {allowed}, got {getattr(self, name)!r}")
        if self.backend == "warp" and self.physics != "default":
            raise ValueError(f"presets of the physics are Bullet's: backend='warp' has no physics={self.physics!r}")
        if not re.fullmatch(r"cpu|cuda(:\d+)?", self.device):
            raise ValueError(f"device must be cpu, cuda or cuda: and a number, got {self.device!r}")
        if self.on_gpu and (self.backend != "warp" or self.processes > 1):
            raise ValueError(
                f"device={self.device!r} needs backend='warp' and workers=1, got {self.backend!r} and {self.processes}"
            )
        if not self.hidden or not all(1 <= units <= MAX_COUNT for units in self.hidden):
            raise ValueError(f"hidden must name at least one layer of at least 1 unit, got {self.hidden}")
        unknown = [key for key in self.observation if key not in OBSERVATION_KEYS]
        if unknown or not self.observation or len(set(self.observation)) < len(self.observation):
            raise ValueError(f"observation must be some of {OBSERVATION_KEYS}, each once, got {self.observation}")
        if self.north_up and not {"lidar", "imu", "target"} <= set(self.observation):
            raise ValueError(f"north_up needs lidar, imu and target in observation, got {self.observation}")
        if self.mirror and (self.north_up or "pose" in self.observation):
            raise ValueError("mirror cannot be had with north_up or pose in observation: a map is not its mirror image")

    def _require_counts(self, *names: str) -> None:
        check_at_least(1, MAX_COUNT, **{name: getattr(self, name) for name in names})

    def _require_positive(self, *names: str) -> None:
        check_positive(MAX_NUMBER, **{name: getattr(self, name) for name in names})

    def _require_share(self, *names: str) -> None:
        for name in names:
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(f"{name} must be between 0 and 1, got {getattr(self, name)}")


@dataclass(frozen=True)
class PPOConfig(TrainingConfig):
    """Settings of PPO: those of every algorithm, and its own."""

    algo: ClassVar[str] = "ppo"
    asynchronous: ClassVar[bool] = False

    decisions: int = 16
    """Decisions of each rover between two updates."""
    epochs: int = 10
    """Passes over the decisions in an update."""
    minibatch: int = 256
    """Decisions in a gradient step."""
    lmbda: float = 0.95
    """Of generalized advantage estimation, for each decision."""
    clip: float = 0.2
    """PPO's bound on the change of an action's probability, relative."""
    entropy: float = 0.003
    """Weight of the bonus for acting at random."""
    imitation: float = 0.0
    """Share of the training, at its start, in which the policy learns to act as a guide with map and pose would where
    it has come to, and the critic what that is worth; 0 learns from the reward alone."""

    def check(self) -> None:
        """Refuses settings that are out of range: see :meth:`TrainingConfig.check`."""
        super().check()
        self._require_counts("decisions", "epochs", "minibatch")
        self._require_positive("clip")
        self._require_share("lmbda", "imitation")
        check_at_least(0, MAX_NUMBER, entropy=self.entropy)


@dataclass(frozen=True)
class SACConfig(TrainingConfig):
    """Settings of SAC: those of every algorithm, and its own."""

    algo: ClassVar[str] = "sac"
    asynchronous: ClassVar[bool] = True

    total_steps: int = 400_000
    decisions: int = 1
    """Decisions of each rover between two rounds of gradient steps."""
    gradient_steps: int = 32
    """Gradient steps in each round."""
    minibatch: int = 256
    """Decisions in a gradient step."""
    buffer: int = 300_000
    """Decisions that the replay buffer holds."""
    warmup: int = 2_000
    """Decisions before the first gradient step."""
    tau: float = 0.005
    """Share of the new value networks that goes into their slow copies in a gradient step."""
    alpha: float = 1.0
    """Weight of the entropy beside the scaled reward, at the start; it is tuned from there. So much has the rovers try
    everything for a while."""
    target_entropy: float = -3.0
    """Entropy that the policy's spread is tuned to, in nats for actions scaled to [-1, 1]."""

    def check(self) -> None:
        """Refuses settings that are out of range: see :meth:`TrainingConfig.check`."""
        super().check()
        self._require_counts("decisions", "gradient_steps", "minibatch", "buffer", "warmup")
        self._require_positive("tau", "alpha")
        self._require_share("tau")
        check_at_least(-MAX_NUMBER, MAX_NUMBER, target_entropy=self.target_entropy)
        if self.buffer < self.num_envs * self.decisions:
            raise ValueError(
                f"buffer={self.buffer} cannot hold the {self.num_envs * self.decisions} decisions of a round"
            )


CONFIGS: dict[str, type[TrainingConfig]] = {config.algo: config for config in (PPOConfig, SACConfig)}
"""Settings by the algorithm's name."""
_Config = TypeVar("_Config", bound=TrainingConfig)


def plain(config: TrainingConfig) -> dict[str, Any]:
    """Settings as plain data, the algorithm's name first."""
    return {"algo": config.algo, **_plain(asdict(config))}


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _plain(entry) for key, entry in value.items()}
    return list(value) if isinstance(value, tuple) else value


def experiments(configs: Sequence[TrainingConfig]) -> list[str]:
    """What the settings of each run are called: the same for runs that differ in their seed only.

    That is algorithm and world, and where others have these too, what the settings do not have in common with theirs.

    Example:
        >>> experiments([PPOConfig(seed=1), PPOConfig(seed=2), SACConfig(gamma=0.9), SACConfig()])
        ['PPO in moon', 'PPO in moon', 'SAC in moon, gamma=0.9', 'SAC in moon, gamma=0.96']
    """
    every = [{key: value for key, value in plain(config).items() if key not in _OF_A_RUN} for config in configs]
    names = []
    for own in every:
        others = [other for other in every if (other["algo"], other["world"]) == (own["algo"], own["world"])]
        special = [f"{key}={value}" for key, value in own.items() if any(other[key] != value for other in others)]
        worlds = own["world"] if isinstance(own["world"], str) else ", ".join(own["world"])
        names.append(", ".join((f"{own['algo'].upper()} in {worlds}", *special)))
    return names


_OF_A_RUN = ("seed", "name", "runs", "backend", "device", "workers", "checkpoint_minutes", "snapshots")
"""Settings that say nothing of what is learned, or how."""


def config_from(data: Any, source: str) -> TrainingConfig:
    """Settings from plain data; what it does not name has its default.

    Args:
        data: as :func:`plain` gives it.
        source: where it comes from, for messages.

    Raises:
        ValueError: for an algorithm or a setting that does not exist, or a value of the wrong type.
    """
    if not isinstance(data, dict) or data.get("algo") not in list(CONFIGS):
        raise ValueError(f"{source} must name an algo, one of {sorted(CONFIGS)}")
    kind = CONFIGS[data["algo"]]
    hints = get_type_hints(kind)
    known = {field.name: hints[field.name] for field in fields(kind)}
    given = {key: value for key, value in data.items() if key != "algo"}
    if unknown := sorted(set(given) - set(known), key=str):
        raise ValueError(
            f"{source} has settings that {kind.algo} does not know: {unknown}; use some of {sorted(known)}"
        )
    return kind(**{key: _converted(value, known[key], f"{key} in {source}") for key, value in given.items()})


def _converted(value: Any, hint: Any, name: str) -> Any:
    """``value`` as a field of type ``hint``, refused where it is of another type."""
    for kind in get_args(hint) if isinstance(hint, UnionType) else (hint,):
        if kind in _TUPLES and isinstance(value, list | tuple) and all(type(entry) is _TUPLES[kind] for entry in value):
            return tuple(value)
        if type(value) is (str if get_origin(kind) is Literal else kind):
            return value
        if kind is float and type(value) is int:
            return float(value)
    raise ValueError(f"{name} must be of type {hint.__name__ if type(hint) is type else hint}, got {value!r}")


_TUPLES: dict[Any, type] = {tuple[str, ...]: str, tuple[int, ...]: int}


def write_config(path: Path, config: TrainingConfig) -> None:
    """Writes settings as YAML."""
    with written_whole(path) as temporary:
        write_through(temporary, yaml.safe_dump(plain(config), sort_keys=False).encode())


def read_config(path: str | Path) -> TrainingConfig:
    """Reads settings from YAML.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is no YAML, or as :func:`config_from`.
    """
    path = Path(path)
    if path.is_dir():
        raise IsADirectoryError(f"{path} is a folder, and settings are in a file, such as a run's config.yaml")
    if not path.is_file():
        raise FileNotFoundError(f"no settings at {path}")
    text = path.read_bytes()
    try:
        data = yaml.safe_load(text.decode())
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise ValueError(f"{path} is no YAML: {' '.join(str(error).split())}") from error
    return config_from(data, str(path))


def run_config(folder: str | Path) -> TrainingConfig:
    """Settings of the run in ``folder``, to go on with it; its folder may have been moved since.

    Raises:
        FileNotFoundError: if there is no run.
        ValueError: if its settings cannot be read.
    """
    folder = Path(folder)
    path = folder / "config.yaml"
    if not path.is_file():
        raise FileNotFoundError(f"no settings at {path}: {folder} is not the folder of a run")
    if not path.read_bytes().endswith(b"\n"):
        raise ValueError(f"{path} is empty, or cut short: the run's settings are lost; begin a new run")
    return replace(read_config(path), runs=str(folder.parent), name=folder.name)


def default_workers(num_envs: int, cores: int | None = None) -> int:
    """One process a core, or the most below that which share ``num_envs`` rovers equally.

    Args:
        num_envs: rovers.
        cores: to use; by default those of this machine that this process may use.
    """
    most = max(1, min(usable_cores() if cores is None else cores, num_envs))
    return next(workers for workers in range(most, 0, -1) if num_envs % workers == 0)


def usable_cores() -> int:
    """Cores of this machine that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
