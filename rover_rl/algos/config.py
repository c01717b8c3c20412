"""Settings of training. Imports no PyTorch, so that the command line can show them at once."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any, ClassVar, Literal, TypeAlias, get_args

from rover_rl.algos.workers import default_workers, usable_cores
from rover_rl.checks import MAX_COUNT, MAX_NUMBER, MAX_ROVERS, check_at_least, check_positive, check_seed
from rover_rl.envs.config import SCAN_POSE, EnvConfig
from rover_rl.envs.parts import HEADING
from rover_rl.envs.sensors.suite import ROUTE, VISITS, require_entries
from rover_rl.sims.backends import BackendLike, name_of, resolve_backend
from rover_rl.tasks.task import get_task

CollectorName: TypeAlias = Literal["auto", "process", "processes", "ray"]
CurriculumKind: TypeAlias = Literal["none", "learnability"]
MemoryKind: TypeAlias = Literal["none", "gru"]
DistributionKind: TypeAlias = Literal["normal", "grid"]
PriorKind: TypeAlias = Literal["none", "route"]
ImageNetworkKind: TypeAlias = Literal["convolutions", "patches"]
ExpertKind: TypeAlias = Literal["map", "route", "predictive"]
TrackerName: TypeAlias = Literal["csv", "tensorboard", "wandb", "trackio", "mlflow"]
"""Experiment trackers that training can send its progress to."""
UNLIMITED_STEPS = 10**9  # effectively unlimited step budget: the time limit ends the training
_SEEDS_OF_A_RUN = 2**32  # number of seeds that a training may use: one per rover, and others each time it is resumed


@dataclass(frozen=True)
class NetworkConfig:
    """Settings of the networks."""

    observation: tuple[str, ...] = ("lidar", "imu", "target", "velocities")
    """Entries of the observation that the policy reads.
    With "pose" it may learn one map by heart, which does not help in another.
    "route" is the shortest way to the goal on a map of what the lidar has seen in the episode, for mazes."""
    north_up: bool = False
    """Also give the policy lidar and target rotated into the world's frame by the IMU's yaw.
    It can recognize places of one map by them without the pose. Needs --no-mirror-augmentation."""
    image_network: ImageNetworkKind = "convolutions"
    """How images, heights and past scans are read: by three convolutions, or by one layer over patches of 4 x 4.
    patches take an eighth of the time on a CPU."""
    hidden: tuple[int, ...] = (128, 128)
    """Number of units in each hidden layer of the actor and the critic."""
    distribution: DistributionKind = "normal"
    """Distribution of actions, in PPO: normal, or grid, in which each of 5 speeds and 11 turns has its probability.
    grid can choose a side where a normal one, between two sides, has its center in the middle. It is for headings."""
    max_std: float = 2.0
    """Largest standard deviation of a normal action before it is squashed to its bounds, in PPO at the start.
    Large values explore fast. Small ones (0.6) keep the policy from relying on chance to leave a corner."""
    memory: MemoryKind = "none"
    """Memory of the actor, in PPO: a GRU after the hidden layers. Give it a rollout_length of 16 or more.
    The policy then decides every action_repeat steps wherever it drives, as in training."""
    memory_size: int = 128
    """Number of units of the memory."""
    prior: PriorKind = "none"
    """What a PPO policy without memory starts from: none, or route (a driver that follows the route).
    It learns what to add to the driver's action. Needs "route" in observation."""
    prior_reach: float = 1.0
    """Largest change of the driver's action by the policy, before squashing.
    With 1, the driver keeps the lead. Where things move, a policy needs more (3) to wait and to give way."""
    prior_share: float = 0.95
    """Largest share of the range of an action that the driver uses.
    With less (0.8), a policy that explores also varies the driver's full speed, and learns when to be slow."""
    privileged_critic: bool = False
    """Let the critic, in PPO, also read what is known only in simulation: true state, local map and path length.
    The actor never reads it."""


@dataclass(frozen=True)
class CollectionConfig:
    """Settings of data collection."""

    collector: CollectorName = "auto"
    """Where rollouts are made: in this process, in processes of this machine, or on a Ray cluster.
    auto: processes if there are several workers.
    ray: the cluster at RAY_ADDRESS, else one that runs here, else a new one here (extra ray)."""
    workers: int | None = None
    """Number of workers that simulate, each with an equal share of the rovers.
    Default: one per core, or the largest number below that divides the rovers equally; 1 for Warp."""
    action_repeat: int = 4
    """Number of steps that each action is held for in training: 4 lets the policy decide at 5 Hz."""
    path_reward: float = 0.0
    """Additional reward in training, per meter gained on the shortest free path to the goal, around walls."""
    route_reward: float = 0.0
    """Additional reward in training, per meter by which the route on what has been seen gets shorter.
    Needs "route" in observation. Unlike path_reward, it needs no map of the world."""
    revisit_penalty: float = 0.0
    """Penalty in training, per second, for each second that the rover has been here before on its way to the goal.
    Needs "visits" in observation. The policy learns to try ways that it has not tried."""
    curriculum: CurriculumKind = "none"
    """How episodes choose their worlds from a range such as "maze:0-999@0-1", in Warp.
    none: evenly.
    learnability: a share of them prefers the worlds in which the policy sometimes succeeds and sometimes fails."""
    curriculum_share: float = 0.5
    """Share of the episodes whose worlds are chosen by learnability. The others choose evenly."""
    curriculum_temperature: float = 0.25
    """Temperature of that choice: weights are p (1 - p) to the power of 1 / temperature, for a success rate p.
    Low ones choose only the most learnable worlds."""


@dataclass(frozen=True)
class AlgorithmConfig:
    """Settings that PPO and SAC share."""

    name: ClassVar[str]
    """Name of the algorithm."""
    asynchronous: ClassVar[bool]
    """Whether it learns while other processes collect, because it can learn from data of older policies."""

    rollout_length: int = 1
    """Number of decisions of each rover between two updates."""
    minibatch: int = 256
    """Number of decisions in a gradient step."""
    critic_warmup: float = 0.0
    """Fraction of training in which only the critic learns, from the start.
    It keeps a policy that is trained further from following a critic that knows nothing yet."""
    gamma: float = 0.96
    """Discount factor per decision."""
    learning_rate: float = 1e-3
    """Learning rate of the Adam optimizer."""
    anneal: bool = True
    """Decrease the learning rate linearly to 0 at the end."""
    reward_scale: float = 0.05
    """Factor of the reward in learning."""
    max_grad_norm: float = 1.0
    """Norm that gradients are clipped to."""
    mirror_augmentation: bool = True
    """Replace every other decision, at random, by its mirror image: left and right are alike."""


@dataclass(frozen=True)
class PPOConfig(AlgorithmConfig):
    """Settings of PPO."""

    name: ClassVar[str] = "ppo"
    asynchronous: ClassVar[bool] = False

    rollout_length: int = 4
    """Number of decisions of each rover between two updates, and with a memory the length of its sequences."""
    minibatch: int = 1024
    """Number of decisions in a gradient step."""
    epochs: int = 4
    """Number of passes over the decisions in an update."""
    lmbda: float = 0.95
    """Lambda of generalized advantage estimation, per decision."""
    clip: float = 0.2
    """Clipping range of the probability ratio."""
    entropy_coef: float = 0.003
    """Coefficient of the entropy bonus."""
    final_std: float | None = None
    """Largest standard deviation of an action at the end, to which that of the network, max_std, decreases linearly.
    With a small one (0.15), the policy drives without exploration as with it. Default: max_std."""
    imitation: float = 0.0
    """Fraction of training that imitates an expert (DAgger), from the start. 0 learns from the reward alone."""
    expert: ExpertKind = "map"
    """Expert to imitate: map (knows the world), predictive (also knows what moves) or route (follows the route on what
    has been seen). predictive needs privileged_critic and a grid, route needs "route" in observation."""
    freeze_encoder: bool = False
    """Keep the convolutions over images as they are in the policy that training starts from, in the critic, too.
    It takes less time, and what the policy sees in images stays what it was. Needs --from."""


@dataclass(frozen=True)
class SACConfig(AlgorithmConfig):
    """Settings of SAC."""

    name: ClassVar[str] = "sac"
    asynchronous: ClassVar[bool] = True

    gradient_steps: int = 32
    """Number of gradient steps after each rollout."""
    buffer_size: int = 300_000
    """Number of decisions that the replay buffer holds."""
    learning_starts: int = 2_000
    """Number of decisions collected before the first gradient step."""
    tau: float = 0.005
    """Coefficient of the soft update of the target networks."""
    alpha: float = 1.0
    """Initial weight of the entropy beside the scaled reward. It is tuned from there."""
    target_entropy: float = -3.0
    """Target entropy of the policy, in nats, for actions scaled to [-1, 1]."""


@dataclass(frozen=True)
class RunConfig:
    """Settings of the run: its length, its folder and what it saves."""

    total_steps: int = 3_000_000
    """Number of steps to train for, all rovers together. A step is 50 ms; a decision counts as action_repeat steps."""
    max_minutes: float | None = None
    """Time limit in minutes, if it comes before total_steps."""
    name: str | None = None
    """Name of the run's folder. Default: a new one such as ppo-maze."""
    runs: str = "runs"
    """Folder that runs are written to."""
    checkpoint_minutes: float = 1.0
    """Minutes between two checkpoints, from which --resume continues."""
    snapshots: int = 20
    """Number of policies kept along the way, evenly spaced, to see later how fast it learned."""
    logger: tuple[TrackerName, ...] = ()
    """Trackers that get what progress.csv gets: csv, tensorboard, wandb, trackio, mlflow (extras of these names)."""
    task_name: str | None = None
    """Task that is learned, if it has a name."""
    started_from: str | None = None
    """Policy that the training starts from: pretrained:NAME, folder of a run, or checkpoint. Default: a new policy."""


@dataclass(frozen=True)
class TrainingConfig:
    """Settings of a training, in parts. A step is 50 ms of one rover; a decision is one action, held for some steps.

    The same ``env.seed`` gives the same policy to the last bit with one worker, unless ``max_minutes`` ends the run.
    """

    env: EnvConfig = field(
        default_factory=lambda: EnvConfig(world="moon", backend="warp", num_envs=512, length=600, seed=0)
    )
    """Environment to train in."""
    network: NetworkConfig = field(default_factory=NetworkConfig)
    """Settings of the networks."""
    collection: CollectionConfig = field(default_factory=CollectionConfig)
    """Settings of data collection."""
    algorithm: AlgorithmConfig = field(default_factory=PPOConfig)
    """Settings of the algorithm."""
    run: RunConfig = field(default_factory=RunConfig)
    """Settings of the run."""

    @property
    def algo(self) -> str:
        return self.algorithm.name

    @property
    def num_envs(self) -> int:
        return 1 if self.env.num_envs is None else self.env.num_envs

    @property
    def groups(self) -> int:
        """Number of groups of rovers that share worlds."""
        return max(1, self.num_envs // max(1, self.env.agents))

    @property
    def seed(self) -> int:
        """Seed of weights, actions, starts and goals; 0 until one is drawn."""
        return self.env.seed or 0

    @property
    def device(self) -> str:
        """Device that networks learn on, and the simulator runs on if it can."""
        return "cpu" if self.env.device is None else self.env.device

    @property
    def on_gpu(self) -> bool:
        return self.device != "cpu"

    @property
    def workers(self) -> int:
        cores = 1 if self.env.backend == "warp" or self.collection.collector == "process" else None
        return self.collection.workers or default_workers(self.groups, cores)

    @property
    def collector(self) -> str:
        """Kind of collector: ``"process"``, ``"processes"`` or ``"ray"``."""
        kind = self.collection.collector
        return kind if kind != "auto" else "processes" if self.workers > 1 else "process"

    @property
    def learner_threads(self) -> int:
        """Number of CPU threads that PPO takes gradient steps with: all cores, whose workers wait for them."""
        return 1 if self.on_gpu else usable_cores()

    @property
    def rovers_per_worker(self) -> int:
        return self.num_envs // self.workers

    def check(self) -> None:
        """Checks the settings. Raises a ``ValueError`` for one out of range, by its name."""
        require_entries(self.network.observation, self.env.own_sensors)
        _check_ranges({name: value for part in PARTS for name, value in vars(getattr(self, part)).items()})
        self._check_network()
        self._check_env()
        self._check_collection()
        if isinstance(self.run.logger, str) or not {*self.run.logger} <= {*get_args(TrackerName)}:
            raise ValueError(f"logger must be a tuple of some of {get_args(TrackerName)}, got {self.run.logger!r}")

    def _check_network(self) -> None:
        network, entries = self.network, {*self.network.observation}
        if not network.hidden or not all(1 <= units <= MAX_COUNT for units in network.hidden):
            raise ValueError(f"hidden must name at least one layer of at least 1 unit, got {network.hidden}")
        if not 0 < network.prior_share < 1:
            raise ValueError(f"prior_share must be greater than 0 and less than 1, got {network.prior_share}")
        if network.prior == "route":
            self._check_prior()
        if network.north_up and not {"lidar", "imu", "target"} <= entries:
            raise ValueError(f"north_up needs lidar, imu and target in observation, got {network.observation}")
        if self.algorithm.mirror_augmentation and (network.north_up or "pose" in entries):
            raise ValueError("mirror_augmentation does not go with north_up, nor with pose in observation")
        for_ppo = network.memory != "none" or network.prior != "none" or network.privileged_critic
        if for_ppo and not isinstance(self.algorithm, PPOConfig):
            raise ValueError(
                f"memory, prior and privileged_critic are for PPO, and the algorithm is {self.algo.upper()}"
            )
        ppo = self.algorithm if isinstance(self.algorithm, PPOConfig) else PPOConfig()
        on_grid = network.distribution == "grid"
        if ppo.imitation and ppo.expert == "predictive" and not (on_grid and network.privileged_critic):
            raise ValueError("expert='predictive' needs distribution='grid' and privileged_critic")
        kind = self.env.action.kind
        if on_grid and (kind != HEADING or network.prior != "none" or not isinstance(self.algorithm, PPOConfig)):
            raise ValueError(f"distribution='grid' is for PPO without a prior and the action heading, got {kind!r}")
        if (self.collection.route_reward or ppo.expert == "route") and "route" not in entries:
            raise ValueError(
                f"route_reward and expert='route' need \"route\" in observation, got {network.observation}"
            )
        if self.collection.revisit_penalty and VISITS not in entries:
            raise ValueError(f'revisit_penalty needs "visits" in observation, got {network.observation}')
        if isinstance(self.algorithm, PPOConfig) and self.algorithm.freeze_encoder and self.run.started_from is None:
            raise ValueError("freeze_encoder keeps the convolutions of a policy that training starts from: use --from")

    def _check_prior(self) -> None:
        from rover_rl.robots import get_robots

        network, robots = self.network, get_robots(self.env.robot)
        if len(robots) > 1:
            raise ValueError(f"prior='route' is for one robot, got {len(robots)}")
        *most, last = entries_of_driver(robots[0].drive.turns_in_place, network.observation)
        if network.memory != "none" or not {*most, last} <= {*network.observation}:
            raise ValueError(
                f"prior='route' needs {', '.join(most)} and {last} in observation and memory='none', got "
                f"{network.observation} and {network.memory!r}"
            )

    def _check_env(self) -> None:
        env = self.env
        check_at_least(1, MAX_ROVERS, num_envs=self.num_envs, agents=env.agents)
        if self.num_envs % env.agents:
            raise ValueError(f"num_envs must be a multiple of agents={env.agents}, got {self.num_envs}")
        check_seed(self.seed, _SEEDS_OF_A_RUN)
        if env.backend == "ray":
            raise ValueError("Ray is a collector: use collector='ray', with backend='bullet', 'mujoco' or 'warp'")
        resolve_backend(env.backend, env.preset)
        if not re.fullmatch(r"cpu|cuda(:\d+)?", self.device):
            raise ValueError(f"device must be cpu, cuda or cuda: and a number, got {self.device!r}")
        if self.on_gpu and (env.backend in ("bullet", "mujoco") or self.workers > 1):
            raise ValueError(
                f"device={self.device!r} needs backend='warp' and workers=1, got {env.backend!r} and {self.workers}"
            )

    def _check_collection(self) -> None:
        given, decisions = self.collection.workers, self.num_envs * self.algorithm.rollout_length
        if self.collection.curriculum != "none" and (backend := _name(self.env.backend)) in ("bullet", "mujoco"):
            raise ValueError(
                f"curriculum needs backend='warp', in which rovers change worlds at resets: in {backend!r} they do not"
            )
        if self.num_envs % self.workers:
            raise ValueError(f"num_envs={self.num_envs} rovers cannot be shared equally by workers={given}")
        if self.rovers_per_worker % self.env.agents:
            raise ValueError(f"agents={self.env.agents} rovers share worlds, and each of workers={given} has fewer")
        if self.collection.collector == "process" and self.workers > 1:
            raise ValueError(f"collector='process' has one worker, got workers={given}")
        most, what = self.rovers_per_worker // self.env.agents, "rovers" if self.env.agents == 1 else "groups"
        if not 1 <= len(self.env.worlds) <= most:
            raise ValueError(
                f"world must name at least one world, and at most the {most} {what} of a worker: got {self.env.world}"
            )
        if isinstance(self.algorithm, SACConfig) and self.algorithm.buffer_size < decisions:
            raise ValueError(
                f"buffer_size={self.algorithm.buffer_size} cannot hold the {decisions} decisions of a rollout"
            )


_COUNTS = (
    *("memory_size", "action_repeat", "rollout_length", "minibatch", "epochs", "gradient_steps", "buffer_size"),
    *("learning_starts", "total_steps", "length", "workers"),
)


def entries_of_driver(turns_in_place: bool, observation: Sequence[str]) -> tuple[str, ...]:
    """Returns the entries that the driver of ``prior="route"`` reads.

    A robot that does not turn in place drives in arcs, which begin at its speed. If the observation has the pose of the
    scan, the driver reads that, too.
    """
    late = [SCAN_POSE] if SCAN_POSE in observation else []
    return ("lidar", "imu", *([] if turns_in_place else ["velocities"]), *late, ROUTE)


_POSITIVE = (
    *("max_std", "final_std", "learning_rate", "reward_scale", "max_grad_norm", "clip", "tau", "alpha"),
    *("checkpoint_minutes", "max_minutes", "curriculum_temperature", "prior_reach"),
)
_NOT_NEGATIVE = ("path_reward", "route_reward", "revisit_penalty", "entropy_coef")
_FRACTIONS = ("gamma", "critic_warmup", "lmbda", "imitation", "tau", "curriculum_share")
_CHOICES = {
    "memory": MemoryKind,
    "image_network": ImageNetworkKind,
    "distribution": DistributionKind,
    "prior": PriorKind,
    "expert": ExpertKind,
    "curriculum": CurriculumKind,
}


def _check_ranges(settings: dict[str, Any]) -> None:
    def some(*names: str) -> dict[str, Any]:
        return {name: settings[name] for name in names if settings.get(name) is not None}

    check_at_least(1, MAX_COUNT, **some(*_COUNTS))
    check_at_least(0, MAX_COUNT, **some("snapshots"))
    check_at_least(0, MAX_NUMBER, **some(*_NOT_NEGATIVE))
    check_at_least(-MAX_NUMBER, MAX_NUMBER, **some("target_entropy"))
    check_positive(MAX_NUMBER, **some(*_POSITIVE))
    for name, value in some(*_FRACTIONS).items():
        if not 0 <= value <= 1:
            raise ValueError(f"{name} must be between 0 and 1, got {value}")
    for name, value in some(*_CHOICES).items():
        if value not in get_args(_CHOICES[name]):
            raise ValueError(f"{name} must be one of {get_args(_CHOICES[name])}, got {value!r}")


def _name(backend: BackendLike) -> str:
    return backend if isinstance(backend, str) else name_of(backend)


ALGORITHMS: dict[str, type[AlgorithmConfig]] = {kind.name: kind for kind in (PPOConfig, SACConfig)}
"""Settings of the algorithms, by name."""
PARTS: dict[str, type] = {
    "env": EnvConfig,
    "network": NetworkConfig,
    "collection": CollectionConfig,
    "algorithm": AlgorithmConfig,
    "run": RunConfig,
}
"""Parts of :class:`TrainingConfig`, by name."""

# Warp simulates many rovers at little more cost than few; SAC's gradient steps take most of the time in any simulator.
# Where steps take long, more gradient steps on each of them pay.
_PPO_ELSEWHERE = {"num_envs": 64, "minibatch": 256, "total_steps": 600_000, "rollout_length": 16, "epochs": 10}
_SAC = {"num_envs": 64, "total_steps": 400_000}


def default_config(algo: str, backend: BackendLike = "warp") -> TrainingConfig:
    """The default settings of ``"ppo"`` or ``"sac"``. Warp has more rovers and larger batches."""
    settings = _SAC if algo == "sac" else {} if _name(backend) == "warp" else _PPO_ELSEWHERE
    return with_settings(TrainingConfig(algorithm=ALGORITHMS[algo]()), backend=backend, **settings)


def training_config(algo: str, **settings: Any) -> TrainingConfig:
    """Settings of a training with ``"ppo"`` or ``"sac"`` by their names alone, each put into its part.

    The settings are fields of the parts of :class:`TrainingConfig`, for example ``world``, ``hidden`` or ``workers``;
    the others are those of :func:`default_config`. Raises a ``ValueError`` for an unknown algorithm or setting.
    """
    if algo not in ALGORITHMS:
        raise ValueError(f"algo must be one of {sorted(ALGORITHMS)}, got {algo!r}")
    return with_settings(default_config(algo, settings.get("backend", "warp")), **settings)


def task_config(name: str, /, learner: str | None = None, **settings: Any) -> TrainingConfig:
    """Settings of a learner of a task, by default of its first one, with other settings by their names alone.

    Raises a ``ValueError`` for an unknown task, learner or setting.
    """
    task = get_task(name)
    if learner is not None and learner not in task.learners:
        raise ValueError(f"task {name} has the learners {[*task.learners]}, got {learner!r}")
    given = {"observation": task.observation, **task.learners[learner or next(iter(task.learners))]}
    config = default_config(given.pop("algo", PPOConfig.name), task.env.backend)
    env = replace(task.env, num_envs=config.num_envs, seed=config.seed)
    return with_settings(replace(config, env=env), task_name=name, **given | settings)


def with_settings(config: TrainingConfig, **settings: Any) -> TrainingConfig:
    """``config`` with other settings, by their names alone: see :func:`training_config`."""
    homes = part_of(config.algo)
    if unknown := sorted(set(settings) - set(homes)):
        raise ValueError(f"{config.algo} does not know the settings {unknown}; use some of {sorted(homes)}")
    for part in PARTS:
        changes = {name: value for name, value in settings.items() if homes[name] == part}
        if changes:
            config = replace(config, **{part: replace(getattr(config, part), **changes)})
    return config


def part_of(algo: str) -> dict[str, str]:
    """The part that each setting belongs to, by the setting's name."""
    kinds = PARTS | {"algorithm": ALGORITHMS[algo]}
    return {item.name: part for part, kind in kinds.items() for item in fields(kind)}
