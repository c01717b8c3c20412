"""Speed of PPO and SAC end to end, compared with Stable-Baselines3 (SB3).

Three trainings of each algorithm run one after another, each on the whole machine: that of rover_rl, with a worker
process for each core; SB3 with all rovers as one ``VecEnv`` in the learning process; and SB3 with ``SubprocVecEnv``, a
process with a ``GymWrapper`` for each rover, the common way to use SB3.

All three have the same environment in Bullet, number of rovers, hidden layers and activation, input scaling, reward
scale and hyperparameters. SB3's time starts when its processes have started; that of rover_rl includes their start. SB3
keeps its own initial weights, optimizers, normalization of advantages and random actions before SAC's learning starts.
The standard deviation of its PPO actions does not depend on the observation, its actions are scaled to [-1, 1], as its
documentation recommends, and it does not augment by mirroring. The processes of 64 rovers need about 14 GB.
"""

from __future__ import annotations

import gc
import multiprocessing
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch
from gymnasium import spaces
from rich.table import Table
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.vec_env import SubprocVecEnv, VecEnv
from torch import Tensor, nn
from torchrl.envs import ActionScaling, EnvBase, RewardScaling

from benchmarks.options import Options
from benchmarks.ratios import told
from rover_rl import GymWrapper
from rover_rl.algos.config import UNLIMITED_STEPS, PPOConfig, SACConfig, TrainingConfig, training_config, with_settings
from rover_rl.algos.policy.networks import ObservationEncoder
from rover_rl.algos.train import train
from rover_rl.algos.train.env import make_training_env
from rover_rl.algos.train.progress import read_progress
from rover_rl.envs.sb3 import SB3VecEnv
from rover_rl.native.threads import single_threaded


def train_ours(config: TrainingConfig) -> float:
    """Steps per second, of all rovers together, as for the others."""
    summary = train(config)
    progress = read_progress(summary.folder / "progress.csv")
    return progress["steps"][-1] / (60 * progress["minutes"][-1])


def train_sb3_on_our_batch(config: TrainingConfig) -> float:
    return train_sb3(config, SB3VecEnv(rovers_for_sb3(with_settings(config, workers=1))))


def train_sb3_on_processes(config: TrainingConfig) -> float:
    # Imported once and shared by all processes. Otherwise each takes seconds and hundreds of megabytes.
    multiprocessing.set_forkserver_preload(["rover_rl.algos.train.ppo", "stable_baselines3", "tyro"])
    return train_sb3(config, SubprocVecEnv([partial(single_rover, config, row) for row in range(config.num_envs)]))


CONTENDERS: dict[str, Callable[[TrainingConfig], float]] = {
    "rover_rl": train_ours,
    "SB3, our batch": train_sb3_on_our_batch,
    "SB3, SubprocVecEnv": train_sb3_on_processes,
}


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
def train_sb3(config: TrainingConfig, envs: VecEnv) -> float:
    torch.manual_seed(config.seed)
    clock = WallClock(60 * config.run.max_minutes)
    make_sb3(config, envs).learn(UNLIMITED_STEPS, callback=clock)
    envs.close()
    return clock.num_timesteps * config.collection.action_repeat / clock.seconds


def make_sb3(config: TrainingConfig, envs: VecEnv) -> BaseAlgorithm:
    algorithm, network = config.algorithm, config.network
    shared = {
        "policy": "MultiInputPolicy",
        "env": envs,
        "learning_rate": algorithm.learning_rate,
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
    """Ends SB3's training after ``limit`` seconds."""

    def __init__(self, limit: float) -> None:
        super().__init__()
        self._limit, self._started = limit, 0.0

    @property
    def seconds(self) -> float:
        return time.perf_counter() - self._started

    def _on_training_start(self) -> None:
        self._started = time.perf_counter()

    def _on_step(self) -> bool:
        return self.seconds < self._limit


def measure(options: Options) -> list[dict[str, Any]]:
    """Trains PPO and SAC with each of :data:`CONTENDERS`. Returns a row for each."""
    rows = []
    for algo in ("ppo", "sac"):
        for name, contender in CONTENDERS.items():
            with TemporaryDirectory() as folder:
                config = make_config(options, algo, Path(folder))
                rate = told(f"{algo.upper()}, {name}", partial(contender, config))
            rows.append({"algo": algo, "name": name, "steps_per_s": rate})
    return rows


def make_config(options: Options, algo: str, folder: Path) -> TrainingConfig:
    """Settings of all trainings: the algorithm's defaults, and a time limit."""
    return training_config(
        algo,
        backend="bullet",
        world=options.world,
        total_steps=UNLIMITED_STEPS,
        max_minutes=options.minutes,
        num_envs=options.rovers,
        mirror_augmentation=False,
        runs=str(folder),
        name="ours",
    )


def table(rows: list[dict[str, Any]]) -> Table:
    table = Table("algorithm", "training", "steps/s", "speedup of rover_rl", title="Training, end to end")
    ours = {row["algo"]: row["steps_per_s"] for row in rows if row["name"] == "rover_rl"}
    for row in rows:
        ratio = ours[row["algo"]] / row["steps_per_s"]
        table.add_row(row["algo"].upper(), row["name"], f"{row['steps_per_s']:,.0f}", f"{ratio:.2f}")
    return table
