"""PPO on a batch of rovers, with TorchRL: collect decisions, estimate advantages, take gradient steps.

Example:
    >>> summary = train_ppo(PPOConfig(world="maze", max_minutes=5))
    >>> summary.checkpoint
    PosixPath('runs/ppo-maze/checkpoint.pt')
"""

from __future__ import annotations

import multiprocessing
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.collectors import BaseCollector, Collector
from torchrl.envs import EnvBase, RandomTruncationTransform, RewardSum, StepCounter
from torchrl.modules import ProbabilisticActor
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

from rover_rl.algos.action_repeat import ActionRepeat
from rover_rl.algos.config import PPOConfig
from rover_rl.algos.policy import OBSERVATION_KEYS, make_actor, make_critic, single_threaded
from rover_rl.algos.progress import BatchStatistics, ProgressLog
from rover_rl.algos.runs import Checkpoint, new_run_folder, write_json
from rover_rl.envs import make_env
from rover_rl.sims.worlds import get_world

__all__ = ["PPOConfig", "TrainingSummary", "make_training_env", "train_ppo"]

LIDAR_POINTS = 32
"""Readings that the policy sees, as the contract has it."""
LEARNED_FROM = (*OBSERVATION_KEYS, "action", "action_log_prob", "advantage", "value_target")
"""Entries of a decision that a gradient step needs."""
LOGGED = ("loss_objective", "loss_critic", "entropy", "kl_approx", "clip_fraction")
"""What is written down of each gradient step."""
EPISODE_SUMS = {"reward": "episode_reward", ("reward_components", "goal"): "episode_goal_reward"}
"""Rewards that are summed over an episode, and where the sums go."""
_SAVE_EVERY = 20
"""Updates between two checkpoints."""


@dataclass(frozen=True)
class TrainingSummary:
    """What a training run came to.

    Attributes:
        folder: of the run, with ``config.json``, ``progress.csv`` and ``checkpoint.pt``.
        steps: trained for, 20 Hz steps of one rover.
        minutes: it took.
        interrupted: whether the user stopped it.
    """

    folder: Path
    steps: int
    minutes: float
    interrupted: bool

    @property
    def checkpoint(self) -> Path:
        """The trained policy."""
        return self.folder / "checkpoint.pt"


@single_threaded()
def train_ppo(config: PPOConfig) -> TrainingSummary:
    """Trains a policy; writes ``config.json``, ``progress.csv`` and ``checkpoint.pt`` to the run's folder.

    Ctrl-C stops early and keeps what was learned.

    Raises:
        ValueError: for an unknown world, or a setting out of range.
        FileExistsError: if there is a run of that name.
    """
    config.check()
    get_world(config.world)
    folder = new_run_folder(config.runs, config.name, f"ppo-{config.world.replace(':', '-')}")
    write_json(folder / "config.json", asdict(config))
    torch.manual_seed(config.seed)
    learner = Learner(config)
    statistics = BatchStatistics()
    share, interrupted = 0.0, False
    with collecting(config, learner.actor) as collector, ProgressLog(folder / "progress.csv") as log:
        try:
            for number, batch in enumerate(collector, 1):
                row = statistics(batch)
                row |= learner.update(batch, config.learning_rate * (1 - share))
                collector.update_policy_weights_()
                share = _share_done(config, statistics.steps, log.minutes)
                log.add(share, row)
                if share >= 1:
                    break
                if number % _SAVE_EVERY == 0:
                    learner.checkpoint(statistics.steps).save(folder / "checkpoint.pt")
        except KeyboardInterrupt:
            interrupted = True
    summary = TrainingSummary(folder, statistics.steps, log.minutes, interrupted)
    learner.checkpoint(statistics.steps).save(summary.checkpoint)
    return summary


class Learner:
    """Actor, critic, and how they learn from a batch of decisions."""

    def __init__(self, config: PPOConfig) -> None:
        self.config = config
        self.actor = make_actor(LIDAR_POINTS, config.hidden)
        self.critic = make_critic(LIDAR_POINTS, config.hidden)
        self._advantage = GAE(gamma=config.gamma, lmbda=config.lmbda, value_network=self.critic, average_gae=True)
        self._loss = ClipPPOLoss(
            self.actor,
            self.critic,
            clip_epsilon=config.clip,
            entropy_coeff=config.entropy,
            critic_coeff=0.5,
            loss_critic_type="l2",
        )
        self._optimizer = torch.optim.Adam(self._loss.parameters(), lr=config.learning_rate)

    def update(self, batch: TensorDictBase, learning_rate: float) -> dict[str, float]:
        """Learns from decisions ``[N, T]``; returns means over the gradient steps."""
        for group in self._optimizer.param_groups:
            group["lr"] = learning_rate
        batch["next", "reward"] *= self.config.reward_scale
        with torch.no_grad():
            self._advantage(batch)
        decisions = batch.select(*LEARNED_FROM).reshape(-1)
        steps = []
        for _ in range(self.config.epochs):
            shuffled = decisions[torch.randperm(len(decisions))]
            steps += [self._gradient_step(part) for part in shuffled.split(self.config.minibatch)]
        means = torch.stack(steps).mean(0).tolist()
        return {"learning_rate": learning_rate, **dict(zip(LOGGED, means, strict=True))}

    def _gradient_step(self, decisions: TensorDictBase) -> Tensor:
        losses = self._loss(decisions)
        self._optimizer.zero_grad()
        (losses["loss_objective"] + losses["loss_critic"] + losses["loss_entropy"]).backward()
        torch.nn.utils.clip_grad_norm_(self._loss.parameters(), self.config.max_grad_norm)
        self._optimizer.step()
        return torch.stack([losses[key].detach() for key in LOGGED])

    def checkpoint(self, steps: int) -> Checkpoint:
        """What has been learned after so many steps."""
        return Checkpoint(
            algorithm="ppo",
            config=asdict(self.config),
            lidar_points=LIDAR_POINTS,
            steps=steps,
            actor=self.actor.state_dict(),
            critic=self.critic.state_dict(),
        )


@contextmanager
def collecting(config: PPOConfig, actor: ProbabilisticActor) -> Iterator[BaseCollector]:
    """A collector of batches ``[num_envs, decisions]``, in this process or in several; closed in the end."""
    frames = config.num_envs * config.decisions
    if config.workers == 1:
        collector = Collector(
            partial(make_training_env, config),
            actor,
            frames_per_batch=frames,
            track_traj_ids=False,
            auto_register_policy_transforms=False,
        )
    else:
        collector = Collector(
            [partial(_make_worker_env, config, worker) for worker in range(config.workers)],
            actor,
            num_collectors=config.workers,
            sync=True,
            frames_per_batch=frames,
            cat_results=0,
            use_buffers=True,
            num_threads=1,
            auto_register_policy_transforms=False,
        )
    try:
        yield collector
    finally:
        collector.shutdown()


def make_training_env(config: PPOConfig, worker: int = 0) -> EnvBase:
    """One worker's rovers, as the policy meets them: a step is a decision.

    The first episode of each row has a random length, so that the rows do not all start over together.
    """
    rows = config.num_envs // config.workers
    env = make_env(
        world_n=config.world,
        length=config.episode_steps,
        lidar_points=LIDAR_POINTS,
        num_envs=rows,
        seed=config.seed + worker * rows,
    )
    longest = -(-config.episode_steps // config.repeat)
    env = env.append_transform(ActionRepeat(config.repeat))
    env = env.append_transform(RewardSum(list(EPISODE_SUMS), list(EPISODE_SUMS.values())))
    env = env.append_transform(StepCounter())
    return env.append_transform(RandomTruncationTransform(min_horizon=1, max_horizon=longest))


def _make_worker_env(config: PPOConfig, worker: int) -> EnvBase:
    """The same in a process of its own, which leaves Ctrl-C to the process that trains."""
    if multiprocessing.parent_process() is not None:
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        torch.manual_seed(config.seed + worker)
    return make_training_env(config, worker)


def _share_done(config: PPOConfig, steps: int, minutes: float) -> float:
    """Share of the budget that is used: of the steps or of the time, whichever is more."""
    return max(steps / config.total_steps, minutes / config.max_minutes if config.max_minutes else 0.0)
