"""Training compared with Stable-Baselines3 (SB3): success rate over wall-clock time.

    python benchmarks/against_sb3.py --algo sac --world moon --minutes 10

Runs three trainings one after another, each on the whole machine:

- rover_rl: :func:`rover_rl.algos.train.train`, as in ``rover-rl train``, with a worker process for each core;
- SB3 with the batched environment: all rovers as one ``VecEnv`` in the learning process (:mod:`rover_rl.envs.sb3`);
- SB3 with ``SubprocVecEnv``: a process with a ``GymWrapper`` for each rover, the common way to use SB3.

All three have the same environment (reward, action repeat, time limits as truncation, first episodes of random length),
number of rovers, hidden layers and activation, input scaling, reward scale and hyperparameters, including the annealed
learning rate. SB3's actions are scaled to [-1, 1], as its documentation recommends. SB3's time starts when its
processes have started; that of rover_rl includes their start.

SB3 keeps its own initial weights, optimizers (one for each network, with its own epsilon for PPO), normalization of
advantages in each minibatch, and random actions before SAC's learning starts. The standard deviation of its PPO actions
does not depend on the observation, and actions are clipped at the bounds, not squashed. SB3 does not augment data by
mirroring; ``--no-mirror-augmentation`` turns this off for rover_rl, too.

Saves a policy every minute, and evaluates all of them after the training, without exploration at 20 Hz, on the same
stored episodes. This takes longer than the trainings. Writes ``against_sb3.json`` and ``against_sb3.png`` to
``runs/against_sb3-sac-moon/``. The processes of 64 rovers need about 14 GB of memory on the moon, and half of that in
the maze.
"""

from __future__ import annotations

import gc
import multiprocessing
import os
import time
from collections.abc import Callable
from copy import deepcopy
from dataclasses import asdict, dataclass
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Literal

import torch
import tyro
from gymnasium import spaces
from matplotlib.figure import Figure
from matplotlib.ticker import PercentFormatter
from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn
from rich.table import Table
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.vec_env import SubprocVecEnv, VecEnv
from tensordict import TensorDictBase
from torch import Tensor, nn
from torchrl.envs import ActionScaling, EnvBase, RewardScaling

from rover_rl import GymWrapper
from rover_rl.algos.config import UNLIMITED_STEPS, PPOConfig, SACConfig, TrainingConfig, training_config, with_settings
from rover_rl.algos.config_files import plain
from rover_rl.algos.evaluation.cores import over_cores
from rover_rl.algos.evaluation.episodes import EpisodeSet, stored_episodes
from rover_rl.algos.evaluation.evaluate import Policy, evaluate
from rover_rl.algos.evaluation.plots import BLUE, GREEN, ORANGE
from rover_rl.algos.policy.checkpoint import Checkpoint
from rover_rl.algos.policy.networks import ObservationEncoder, action_spec, middle_and_half, single_threaded
from rover_rl.algos.train import train
from rover_rl.algos.train.env import make_training_env
from rover_rl.algos.train.progress import read_progress
from rover_rl.algos.train.run_folder import new_run_folder
from rover_rl.envs.config import ActionConfig
from rover_rl.envs.sb3 import SB3VecEnv
from rover_rl.files import write_json, written_whole


@dataclass
class Options:
    """Compare training with Stable-Baselines3."""

    algo: Literal["ppo", "sac"] = "sac"
    """Learning algorithm."""
    world: str = "moon"
    """World: inspect, moon or maze."""
    minutes: float = 10.0
    """Duration of each training in minutes."""
    num_envs: int = 64
    """Number of rovers."""
    count: int = 128
    """Number of episodes that each saved policy is evaluated on."""
    seconds: float = 60.0
    """Time limit of an episode, s."""
    mirror_augmentation: bool = True
    """Whether rover_rl augments its data by mirroring. SB3 does not."""
    seed: int = 0
    """Seed of weights, actions, starts and goals."""
    runs: Path = Path("runs")
    """Folder in which the output folder is created."""

    def config(self, folder: Path) -> TrainingConfig:
        """Settings of all trainings: the algorithm's defaults, and a time limit."""
        return training_config(
            self.algo,
            # Both programs simulate in Bullet.
            backend="bullet",
            world=self.world,
            total_steps=UNLIMITED_STEPS,
            max_minutes=self.minutes,
            snapshots=max(1, round(self.minutes)),
            num_envs=self.num_envs,
            mirror_augmentation=self.mirror_augmentation,
            seed=self.seed,
            runs=str(folder),
            name="ours",
        )


@dataclass(frozen=True)
class Snapshot:
    """A policy saved during training.

    Attributes:
        minutes: training time.
        steps: number of steps, all rovers together.
        policy: the policy.
    """

    minutes: float
    steps: int
    policy: Policy


def train_ours(config: TrainingConfig) -> list[Snapshot]:
    """Trains with rover_rl. Returns the snapshots and the final policy."""
    summary = train(config)
    progress = read_progress(summary.folder / "progress.csv")
    minutes = dict(zip(progress["steps"], progress["minutes"], strict=True))
    paths = [*sorted((summary.folder / "snapshots").glob("*.pt")), summary.checkpoint]
    checkpoints = {checkpoint.steps: checkpoint for checkpoint in map(Checkpoint.load, paths)}
    return [Snapshot(minutes[steps], steps, checkpoint.make_actor()) for steps, checkpoint in checkpoints.items()]


def train_sb3_on_our_batch(config: TrainingConfig) -> list[Snapshot]:
    """Trains with SB3, with all rovers as one VecEnv."""
    return train_sb3(config, SB3VecEnv(rovers_for_sb3(with_settings(config, workers=1))))


def train_sb3_on_processes(config: TrainingConfig) -> list[Snapshot]:
    """Trains with SB3, with a process for each rover."""
    # Imported once and shared by all processes. Otherwise each takes seconds and hundreds of megabytes.
    multiprocessing.set_forkserver_preload(
        ["rover_rl.algos.train.ppo", "rover_rl.algos.evaluation.plots", "stable_baselines3", "tyro"]
    )
    return train_sb3(config, SubprocVecEnv([partial(single_rover, config, row) for row in range(config.num_envs)]))


def rovers_for_sb3(config: TrainingConfig) -> EnvBase:
    """The training environment of rover_rl, with scaled rewards and actions."""
    env = make_training_env(config).append_transform(RewardScaling(0.0, config.algorithm.reward_scale))
    return env.append_transform(ActionScaling())


def single_rover(config: TrainingConfig, row: int) -> GymWrapper:
    """Row ``row`` of the batch as a separate environment."""
    gc.freeze()  # keeps the garbage collector from writing to memory that the processes share
    torch.set_num_threads(1)
    torch.manual_seed(config.seed + row)
    config = with_settings(config, num_envs=1, workers=1, seed=config.seed + row)
    return GymWrapper(rovers_for_sb3(config), time_limit="truncated")


@single_threaded()
def train_sb3(config: TrainingConfig, envs: VecEnv) -> list[Snapshot]:
    """Trains with SB3 until the time limit. Returns a snapshot for each minute."""
    torch.manual_seed(config.seed)
    with WallClock(config) as clock:
        make_sb3(config, envs, clock.learning_rate).learn(UNLIMITED_STEPS, callback=clock)
    envs.close()
    return clock.snapshots


def make_sb3(config: TrainingConfig, envs: VecEnv, learning_rate: Callable[[float], float]) -> BaseAlgorithm:
    """Creates SB3's algorithm with the settings of rover_rl."""
    algorithm, network = config.algorithm, config.network
    shared = {
        "policy": "MultiInputPolicy",
        "env": envs,
        "learning_rate": learning_rate,
        "batch_size": algorithm.minibatch,
        "gamma": algorithm.gamma,
        "seed": config.seed,
        "device": "cpu",
        "policy_kwargs": {
            "net_arch": list(network.hidden),
            "activation_fn": nn.ReLU,
            "features_extractor_class": RoverFeatures,
            "features_extractor_kwargs": {"keys": network.observation, "north_up": network.north_up},
        },
    }
    if isinstance(algorithm, PPOConfig):
        return PPO(
            n_steps=algorithm.rollout_length,
            n_epochs=algorithm.epochs,
            gae_lambda=algorithm.lmbda,
            clip_range=algorithm.clip,
            ent_coef=algorithm.entropy_coef,
            max_grad_norm=algorithm.max_grad_norm,
            **shared,
        )
    assert isinstance(algorithm, SACConfig)
    return SAC(
        train_freq=algorithm.rollout_length,
        gradient_steps=algorithm.gradient_steps,
        buffer_size=algorithm.buffer_size,
        learning_starts=algorithm.learning_starts,
        tau=algorithm.tau,
        ent_coef=f"auto_{algorithm.alpha}",
        target_entropy=algorithm.target_entropy,
        **shared,
    )


class RoverFeatures(BaseFeaturesExtractor):
    """Feature extractor for SB3 with the input scaling of rover_rl."""

    def __init__(self, observation_space: spaces.Dict, keys: tuple[str, ...], north_up: bool) -> None:
        encoder = ObservationEncoder(keys, observation_space["lidar"].shape[0], north_up)
        super().__init__(observation_space, encoder.features)
        self._encoder = encoder

    def forward(self, observation: dict[str, Tensor]) -> Tensor:
        return self._encoder(*(observation[key] for key in self._encoder.keys))


class WallClock(BaseCallback):
    """Ends SB3's training at the time limit, saves snapshots and shows the progress."""

    def __init__(self, config: TrainingConfig) -> None:
        super().__init__()
        self.snapshots: list[Snapshot] = []
        self._config = config
        self._started, self._marks = 0.0, 0
        self._bar = Progress(
            TextColumn("training"),
            BarColumn(20),
            TaskProgressColumn(),
            TimeElapsedColumn(),
            TextColumn("{task.fields[status]}"),
            disable=not Console().is_terminal,
        )
        self._task = self._bar.add_task("", total=1.0, status="starting")

    def __enter__(self) -> WallClock:
        self._bar.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._bar.stop()

    @property
    def minutes(self) -> float:
        """Minutes since the training began."""
        return (time.perf_counter() - self._started) / 60 if self._started else 0.0

    @property
    def share(self) -> float:
        """Fraction of the time that is used."""
        return min(1.0, self.minutes / self._config.run.max_minutes)

    def learning_rate(self, remaining: float) -> float:
        """The current learning rate. SB3's ``remaining`` counts steps, and is ignored: time ends the training."""
        algorithm = self._config.algorithm
        return algorithm.learning_rate * (1 - self.share if algorithm.anneal else 1.0)

    def _on_training_start(self) -> None:
        self._started = time.perf_counter()

    def _on_step(self) -> bool:
        share, steps = self.share, self.num_timesteps * self._config.collection.action_repeat
        marks = int(share * self._config.run.snapshots)
        if marks > self._marks:
            self._marks = marks
            policy = policy_of_sb3(deepcopy(self.model.policy), self._config.env.bounded_action)
            self.snapshots.append(Snapshot(self.minutes, steps, policy))
            self._bar.console.print(f"{share:4.0%} of training: {steps:,} steps", highlight=False)
        self._bar.update(self._task, completed=share, status=f"{steps:,} steps")
        return share < 1


def policy_of_sb3(policy: BasePolicy, action: ActionConfig) -> Policy:
    """Wraps a policy of SB3 for the evaluation. It acts without exploration.

    Args:
        policy: the policy.
        action: bounds of the action.
    """
    return partial(_act, policy, *middle_and_half(action_spec(action)))


def _act(policy: BasePolicy, middle: Tensor, half: Tensor, now: TensorDictBase) -> TensorDictBase:
    observation = {key: now[key].numpy() for key in policy.observation_space}
    action, _ = policy.predict(observation, deterministic=True)
    return now.set("action", middle + half * torch.from_numpy(action))


@dataclass(frozen=True)
class Point:
    """Result of a snapshot.

    Attributes:
        minutes: training time.
        steps: number of training steps.
        success: success rate.
        low, high: 95 % confidence interval of the success rate.
    """

    minutes: float
    steps: int
    success: float
    low: float
    high: float


@dataclass(frozen=True)
class Curve:
    """Success rate over wall-clock time."""

    name: str
    points: list[Point]

    @property
    def final(self) -> Point:
        """The last point."""
        return self.points[-1]


CONTENDERS: dict[str, Callable[[TrainingConfig], list[Snapshot]]] = {
    "rover_rl": train_ours,
    "SB3, our batch": train_sb3_on_our_batch,
    "SB3, SubprocVecEnv": train_sb3_on_processes,
}
COLORS = dict(zip(CONTENDERS, (BLUE, ORANGE, GREEN), strict=True))


def measure(name: str, snapshots: list[Snapshot], episodes: EpisodeSet, seconds: float) -> Curve:
    """Evaluates all snapshots."""
    return Curve(name, over_cores(partial(point, episodes, seconds), snapshots, "measuring"))


def point(episodes: EpisodeSet, seconds: float, snapshot: Snapshot) -> Point:
    """Evaluates a snapshot."""
    result = evaluate(snapshot.policy, episodes, seconds=seconds)
    return Point(snapshot.minutes, snapshot.steps, result.success_rate, *result.interval)


@dataclass(frozen=True)
class Comparison:
    """Comparison of rover_rl with a training of SB3.

    Attributes:
        name: name of SB3's training.
        success: final success rate of SB3.
        minutes: training time of SB3.
        first_minutes: time until SB3 first had that success rate.
        our_minutes: time until rover_rl had it; ``None`` if it never did.
        share: ``our_minutes`` as a fraction of ``minutes``.
    """

    name: str
    success: float
    minutes: float
    first_minutes: float
    our_minutes: float | None
    share: float | None


def compare(ours: Curve, theirs: Curve) -> Comparison:
    """Compares the times until the final success rate of SB3."""
    success, minutes = theirs.final.success, theirs.final.minutes
    first = next(point.minutes for point in theirs.points if point.success >= success)
    our_minutes = next((point.minutes for point in ours.points if point.success >= success), None)
    share = None if our_minutes is None else our_minutes / minutes
    return Comparison(theirs.name, success, minutes, first, our_minutes, share)


def write(folder: Path, config: TrainingConfig, count: int, curves: list[Curve]) -> None:
    """Writes the results and the plot. Called after each training, so that an interruption loses nothing."""
    comparisons = [compare(curves[0], curve) for curve in curves[1:]]
    libraries = ("torch", "torchrl", "stable_baselines3")
    results = {
        "config": plain(config),
        "episodes": count,
        "cores": os.cpu_count(),
        "versions": {name: version(name) for name in libraries},
        "curves": [asdict(curve) for curve in curves],
        "comparisons": [asdict(comparison) for comparison in comparisons],
    }
    write_json(folder / "against_sb3.json", results)
    draw(folder / "against_sb3.png", config, count, curves, comparisons)


def draw(path: Path, config: TrainingConfig, count: int, curves: list[Curve], comparisons: list[Comparison]) -> None:
    """Plots success rate over time, and marks where rover_rl has the final success rate of SB3."""
    figure = Figure(figsize=(8, 5), layout="constrained")
    ax = figure.subplots()
    for curve in curves:
        minutes, _, success, low, high = zip(*(asdict(point).values() for point in curve.points), strict=True)
        label = f"{curve.name}: {curve.final.steps:,} steps, {curve.final.success:.0%} at the end"
        ax.plot(minutes, success, "o-", markersize=4, linewidth=2, color=COLORS[curve.name], label=label)
        ax.fill_between(minutes, low, high, color=COLORS[curve.name], alpha=0.15, linewidth=0)
    reached = sorted((one for one in comparisons if one.our_minutes is not None), key=lambda one: one.success)
    for rank, comparison in enumerate(reached):
        ends = (comparison.our_minutes, comparison.minutes)
        color = COLORS[comparison.name]
        ax.plot(ends, [comparison.success] * 2, "|:", markersize=12, markeredgewidth=2, color=color)
        note = f"{comparison.our_minutes:.1f} of {comparison.minutes:.1f} min: {comparison.share:.0%} of the time"
        box = {"facecolor": "white", "alpha": 0.8, "linewidth": 0, "pad": 1}
        # The lower note is below its line and the other one above, so that they do not overlap.
        place = {"xy": (ends[0], comparison.success), "xytext": (4, 6 if rank else -14), "textcoords": "offset points"}
        ax.annotate(note, **place, color=color, bbox=box)
    ax.set_title(f"{config.algo.upper()} in {config.env.world}: {config.num_envs} rovers, {os.cpu_count()} cores")
    ax.set(xlabel="wall-clock time, minutes", ylabel=f"success rate on {count} episodes", xlim=(0, None), ylim=(0, 1))
    ax.yaxis.set_major_formatter(PercentFormatter(1.0))
    ax.spines[["top", "right"]].set_visible(False)
    ax.grid(alpha=0.3)
    figure.legend(loc="outside lower center", frameon=False)
    with written_whole(path) as temporary:
        figure.savefig(temporary, dpi=150)


def show(console: Console, curves: list[Curve]) -> None:
    """Prints a table of the results."""
    table = Table("", "steps", "final success", "first reached after", "rover_rl after", "fraction of the time")
    for curve in curves:
        final, comparison = curve.final, compare(curves[0], curve)
        ours, share = comparison.our_minutes, comparison.share
        beside = ("never" if ours is None else f"{ours:.1f} min", "-" if share is None else f"{share:.0%}")
        table.add_row(
            curve.name,
            f"{final.steps:,}",
            f"{final.success:.1%} ({final.low:.0%} to {final.high:.0%})",
            f"{comparison.first_minutes:.1f} min",
            *(beside if curve is not curves[0] else ()),
        )
    console.print(table)


def main(options: Options) -> None:
    """Runs all trainings, evaluates them, writes the results and prints a table."""
    console = Console()
    episodes = stored_episodes(options.world).first(options.count)
    name = f"against_sb3-{options.algo}-{options.world}"
    folder = new_run_folder(options.runs, None, name)
    config = options.config(folder)
    curves: list[Curve] = []
    for number, (contender, train_contender) in enumerate(CONTENDERS.items(), 1):
        console.rule(f"{number} of {len(CONTENDERS)}: {contender}, {options.minutes:g} minutes")
        curves.append(measure(contender, train_contender(config), episodes, options.seconds))
        write(folder, config, options.count, curves)
    show(console, curves)
    console.print(f"{folder / 'against_sb3.json'} and {folder / 'against_sb3.png'}")


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
