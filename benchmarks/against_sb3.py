"""Our training beside Stable-Baselines3's: success against the wall clock.

    python benchmarks/against_sb3.py --algo sac --world moon --minutes 10

Three trainings, one after another, each with the whole machine to itself:

- ours: ``train_ppo`` or ``train_sac``, as ``rover-rl train`` runs them, with a process a core;
- SB3 on our batch: all rovers as one ``VecEnv`` in the process that learns (:mod:`rover_rl.envs.sb3`);
- SB3 on ``SubprocVecEnv``: a process for each rover, with a ``GymWrapper`` in it, as people use it.

SB3 gets the same as ours: the very environment (reward, action repeat, time limits as truncation, first episodes of
random length), rovers, hidden layers and their activation, input scaling, reward scale, and every hyperparameter of the
settings, the falling learning rate included; actions are scaled to [-1, 1], as it recommends. Its clock starts when
its processes are up, while ours includes starting them. What stays its own: how its weights begin, an optimizer for
each network and PPO's epsilon in it, the spread of PPO's actions, which depends on no observation and is cut off at
the bounds instead of squashed, advantages that are normalized in each minibatch, random actions during SAC's warmup,
and that it does not learn from mirror images (``--no-mirror`` takes them from ours, too).

Policies are kept every minute, and drive the same stored episodes afterwards, off the clock: without exploration, a
decision every 0.05 s. This takes longer than the trainings. Results are in ``runs/against_sb3-sac-moon/``:
``against_sb3.json`` and ``against_sb3.png``. The processes of 64 rovers need about 14 GB of memory on the moon, and
half of that in the maze.
"""

from __future__ import annotations

import gc
import multiprocessing
import os
import time
from collections.abc import Callable
from copy import deepcopy
from dataclasses import asdict, dataclass, replace
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
from rover_rl.algos.config import CONFIGS, ENDLESS, PPOConfig, SACConfig, TrainingConfig, plain
from rover_rl.algos.evaluation.cores import over_cores
from rover_rl.algos.evaluation.episodes import EpisodeSet, stored_episodes
from rover_rl.algos.evaluation.evaluate import Policy, evaluate
from rover_rl.algos.evaluation.plots import BLUE, GREEN, ORANGE
from rover_rl.algos.policy.checkpoint import Checkpoint, new_run_folder
from rover_rl.algos.policy.networks import ObservationEncoder, action_spec, middle_and_half, single_threaded
from rover_rl.algos.train.env import make_training_env
from rover_rl.algos.train.ppo import train_ppo
from rover_rl.algos.train.progress import read_progress
from rover_rl.algos.train.sac import train_sac
from rover_rl.envs.sb3 import SB3VecEnv
from rover_rl.files import write_json, written_whole


@dataclass
class Options:
    """What to compare."""

    algo: Literal["ppo", "sac"] = "sac"
    """Learning algorithm of both."""
    world: str = "moon"
    """World to train and to drive in: inspect, moon or maze."""
    minutes: float = 10.0
    """Wall clock of each training."""
    num_envs: int = 64
    """Rovers that drive at once."""
    count: int = 128
    """Episodes that every kept policy drives."""
    seconds: float = 60.0
    """Time in which a goal has to be reached."""
    mirror: bool = True
    """Let ours learn from mirror images, which SB3 does not."""
    seed: int = 0
    """Of weights, actions, starts and goals."""
    runs: Path = Path("runs")
    """Folder that the results' folder is made in."""

    def config(self, folder: Path) -> TrainingConfig:
        """Settings of all trainings: the algorithm's own, and a time limit."""
        return CONFIGS[self.algo](
            world=self.world,
            total_steps=ENDLESS,
            max_minutes=self.minutes,
            snapshots=max(1, round(self.minutes)),
            num_envs=self.num_envs,
            mirror=self.mirror,
            seed=self.seed,
            runs=str(folder),
            name="ours",
        )


@dataclass(frozen=True)
class Snapshot:
    """A policy from along the way."""

    minutes: float
    steps: int
    policy: Policy


def train_ours(config: TrainingConfig) -> list[Snapshot]:
    """Trains, and returns the snapshots and the last policy."""
    summary = train_ppo(config) if isinstance(config, PPOConfig) else train_sac(config)
    progress = read_progress(summary.folder / "progress.csv")
    minutes = dict(zip(progress["steps"], progress["minutes"], strict=True))
    paths = [*sorted((summary.folder / "snapshots").glob("*.pt")), summary.checkpoint]
    checkpoints = {checkpoint.steps: checkpoint for checkpoint in map(Checkpoint.load, paths)}
    return [Snapshot(minutes[steps], steps, checkpoint.make_actor()) for steps, checkpoint in checkpoints.items()]


def train_sb3_on_our_batch(config: TrainingConfig) -> list[Snapshot]:
    """Trains with all rovers as one VecEnv."""
    return train_sb3(config, SB3VecEnv(rovers_for_sb3(replace(config, workers=1))))


def train_sb3_on_processes(config: TrainingConfig) -> list[Snapshot]:
    """Trains with a process for each rover."""
    # Read once, and shared by all processes: else each would take seconds and hundreds of megabytes.
    multiprocessing.set_forkserver_preload(
        ["rover_rl.algos.train.ppo", "rover_rl.algos.evaluation.plots", "stable_baselines3", "tyro"]
    )
    return train_sb3(config, SubprocVecEnv([partial(single_rover, config, row) for row in range(config.num_envs)]))


def rovers_for_sb3(config: TrainingConfig) -> EnvBase:
    """The environment that ours trains in, with rewards and actions scaled, which ours does elsewhere."""
    env = make_training_env(config).append_transform(RewardScaling(0.0, config.reward_scale))
    return env.append_transform(ActionScaling())


def single_rover(config: TrainingConfig, row: int) -> GymWrapper:
    """Row ``row`` of the batch, by itself."""
    gc.freeze()  # what the processes share stays shared: the collector does not write into it
    torch.set_num_threads(1)
    torch.manual_seed(config.seed + row)
    config = replace(config, num_envs=1, workers=1, seed=config.seed + row)
    return GymWrapper(rovers_for_sb3(config), time_limit="truncated")


@single_threaded()
def train_sb3(config: TrainingConfig, envs: VecEnv) -> list[Snapshot]:
    """Trains until the time is up, and returns a policy for each minute."""
    torch.manual_seed(config.seed)
    with WallClock(config) as clock:
        make_sb3(config, envs, clock.learning_rate).learn(ENDLESS, callback=clock)
    envs.close()
    return clock.snapshots


def make_sb3(config: TrainingConfig, envs: VecEnv, learning_rate: Callable[[float], float]) -> BaseAlgorithm:
    """SB3's algorithm with our settings."""
    shared = {
        "policy": "MultiInputPolicy",
        "env": envs,
        "learning_rate": learning_rate,
        "batch_size": config.minibatch,
        "gamma": config.gamma,
        "seed": config.seed,
        "device": "cpu",
        "policy_kwargs": {
            "net_arch": list(config.hidden),
            "activation_fn": nn.ReLU,
            "features_extractor_class": RoverFeatures,
            "features_extractor_kwargs": {"keys": config.observation, "north_up": config.north_up},
        },
    }
    if isinstance(config, PPOConfig):
        return PPO(
            n_steps=config.decisions,
            n_epochs=config.epochs,
            gae_lambda=config.lmbda,
            clip_range=config.clip,
            ent_coef=config.entropy,
            max_grad_norm=config.max_grad_norm,
            **shared,
        )
    assert isinstance(config, SACConfig)
    return SAC(
        train_freq=config.decisions,
        gradient_steps=config.gradient_steps,
        buffer_size=config.buffer,
        learning_starts=config.warmup,
        tau=config.tau,
        ent_coef=f"auto_{config.alpha}",
        target_entropy=config.target_entropy,
        **shared,
    )


class RoverFeatures(BaseFeaturesExtractor):
    """Our input scaling, for SB3's networks."""

    def __init__(self, observation_space: spaces.Dict, keys: tuple[str, ...], north_up: bool) -> None:
        encoder = ObservationEncoder(keys, observation_space["lidar"].shape[0], north_up)
        super().__init__(observation_space, encoder.features)
        self._encoder = encoder

    def forward(self, observation: dict[str, Tensor]) -> Tensor:
        return self._encoder(*(observation[key] for key in self._encoder.keys))


class WallClock(BaseCallback):
    """Ends SB3's training when the time is up, keeps policies from along the way, and shows how far it is."""

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
        """Since training began."""
        return (time.perf_counter() - self._started) / 60 if self._started else 0.0

    @property
    def share(self) -> float:
        """Of the time that is used."""
        return min(1.0, self.minutes / self._config.max_minutes)

    def learning_rate(self, remaining: float) -> float:
        """The learning rate now; SB3's idea of what remains counts steps, and is of no use here."""
        return self._config.learning_rate * (1 - self.share if self._config.anneal else 1.0)

    def _on_training_start(self) -> None:
        self._started = time.perf_counter()

    def _on_step(self) -> bool:
        share, steps = self.share, self.num_timesteps * self._config.repeat
        marks = int(share * self._config.snapshots)
        if marks > self._marks:
            self._marks = marks
            policy = policy_of_sb3(deepcopy(self.model.policy), self._config.reverse)
            self.snapshots.append(Snapshot(self.minutes, steps, policy))
            self._bar.console.print(f"{share:4.0%} of training: {steps:,} steps", highlight=False)
        self._bar.update(self._task, completed=share, status=f"{steps:,} steps")
        return share < 1


def policy_of_sb3(policy: BasePolicy, reverse: bool) -> Policy:
    """A policy of SB3 as one that our evaluation drives with; it knows no exploration."""
    return partial(_act, policy, *middle_and_half(action_spec(reverse)))


def _act(policy: BasePolicy, middle: Tensor, half: Tensor, now: TensorDictBase) -> TensorDictBase:
    observation = {key: now[key].numpy() for key in policy.observation_space}
    action, _ = policy.predict(observation, deterministic=True)
    return now.set("action", middle + half * torch.from_numpy(action))


@dataclass(frozen=True)
class Point:
    """How a snapshot fared; ``low`` and ``high`` are the 95 % interval of its success."""

    minutes: float
    steps: int
    success: float
    low: float
    high: float


@dataclass(frozen=True)
class Curve:
    """Success against the wall clock."""

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
    """Drives the episodes with every snapshot."""
    return Curve(name, over_cores(partial(point, episodes, seconds), snapshots, "measuring"))


def point(episodes: EpisodeSet, seconds: float, snapshot: Snapshot) -> Point:
    """Drives the episodes with a snapshot."""
    result = evaluate(snapshot.policy, episodes, seconds=seconds)
    return Point(snapshot.minutes, snapshot.steps, result.success_rate, *result.interval)


@dataclass(frozen=True)
class Comparison:
    """Ours beside one of SB3's.

    Attributes:
        name: of SB3's.
        success: that it had in the end.
        minutes: that it was trained for.
        first_minutes: until it was as successful for the first time.
        our_minutes: until ours was; ``None`` if it never was.
        share: of its time that ours took.
    """

    name: str
    success: float
    minutes: float
    first_minutes: float
    our_minutes: float | None
    share: float | None


def compare(ours: Curve, theirs: Curve) -> Comparison:
    """How long each took to SB3's final success."""
    success, minutes = theirs.final.success, theirs.final.minutes
    first = next(point.minutes for point in theirs.points if point.success >= success)
    our_minutes = next((point.minutes for point in ours.points if point.success >= success), None)
    share = None if our_minutes is None else our_minutes / minutes
    return Comparison(theirs.name, success, minutes, first, our_minutes, share)


def write(folder: Path, config: TrainingConfig, count: int, curves: list[Curve]) -> None:
    """Writes figures and picture; again after each training, so that nothing is lost."""
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
    """Draws success against minutes, and where ours reaches what SB3 had in the end."""
    figure = Figure(figsize=(8, 5), layout="constrained")
    ax = figure.subplots()
    for curve in curves:
        minutes, _, success, low, high = zip(*(asdict(point).values() for point in curve.points), strict=True)
        label = f"{curve.name}: {curve.final.steps:,} steps, {curve.final.success:.0%} in the end"
        ax.plot(minutes, success, "o-", markersize=4, linewidth=2, color=COLORS[curve.name], label=label)
        ax.fill_between(minutes, low, high, color=COLORS[curve.name], alpha=0.15, linewidth=0)
    reached = sorted((one for one in comparisons if one.our_minutes is not None), key=lambda one: one.success)
    for rank, comparison in enumerate(reached):
        ends = (comparison.our_minutes, comparison.minutes)
        color = COLORS[comparison.name]
        ax.plot(ends, [comparison.success] * 2, "|:", markersize=12, markeredgewidth=2, color=color)
        note = f"{comparison.our_minutes:.1f} of {comparison.minutes:.1f} min: {comparison.share:.0%} of its time"
        box = {"facecolor": "white", "alpha": 0.8, "linewidth": 0, "pad": 1}
        # The lower one's below its line and the other's above, so that they do not meet where both ended alike.
        place = {"xy": (ends[0], comparison.success), "xytext": (4, 6 if rank else -14), "textcoords": "offset points"}
        ax.annotate(note, **place, color=color, bbox=box)
    ax.set_title(f"{config.algo.upper()} in {config.world}: {config.num_envs} rovers, {os.cpu_count()} cores")
    ax.set(xlabel="minutes of wall clock", ylabel=f"success on {count} episodes", xlim=(0, None), ylim=(0, 1))
    ax.yaxis.set_major_formatter(PercentFormatter(1.0))
    ax.spines[["top", "right"]].set_visible(False)
    ax.grid(alpha=0.3)
    figure.legend(loc="outside lower center", frameon=False)
    with written_whole(path) as temporary:
        figure.savefig(temporary, dpi=150)


def show(console: Console, curves: list[Curve]) -> None:
    """Prints how they fared."""
    table = Table("", "steps", "success in the end", "first after", "ours after", "share of its time")
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
    """Trains, drives, and tells."""
    console = Console()
    episodes = stored_episodes(options.world).first(options.count)
    name = f"against_sb3-{options.algo}-{options.world}"
    folder = new_run_folder(options.runs, None, name)
    config = options.config(folder)
    curves: list[Curve] = []
    for number, (contender, train) in enumerate(CONTENDERS.items(), 1):
        console.rule(f"{number} of {len(CONTENDERS)}: {contender}, {options.minutes:g} minutes")
        curves.append(measure(contender, train(config), episodes, options.seconds))
        write(folder, config, options.count, curves)
    show(console, curves)
    console.print(f"{folder / 'against_sb3.json'} and {folder / 'against_sb3.png'}")


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
