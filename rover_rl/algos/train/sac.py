"""SAC on a batch of rovers, with TorchRL: drive a little, remember it, take gradient steps on what is remembered.

With several workers they drive on meanwhile, with a policy that is a batch behind: SAC learns from older ones anyway.

Read it from the top: :func:`train_sac` is the loop, :class:`SACLearner` what happens in it. Batches come from
:mod:`rover_rl.algos.train.collectors`, the networks are in :mod:`rover_rl.algos.policy.networks`, and the run's folder,
log, checkpoints and Ctrl-C are in :mod:`rover_rl.algos.train.run`.

TorchRL 0.14's ``SACTrainer`` was tried, too, for 102,000 steps in inspect, and learns with the same losses. Its default
file leaves out the replay buffer; ``torchrl.checkpoint.Checkpoint`` has it, but killed between its two renames leaves
no checkpoint in place. ``init_random_frames`` counts steps in the trainer and decisions in the collector. On stopping
and resuming see :mod:`rover_rl.algos.train.ppo`.

Example:
    >>> summary = train_sac(SACConfig(max_minutes=10))
    >>> summary.checkpoint
    PosixPath('runs/sac-moon/checkpoint.pt')
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import LazyTensorStorage, ReplayBuffer
from torchrl.objectives import SACLoss, SoftUpdate

from rover_rl.algos.config import SACConfig, TrainingConfig
from rover_rl.algos.policy.networks import (
    ObservationEncoder,
    action_spec,
    make_action_critic,
    make_actor,
    middle_and_half,
    mirrored,
    on_features,
    single_threaded,
)
from rover_rl.algos.train.progress import Stopwatch
from rover_rl.algos.train.run import TrainingRun, TrainingSummary, prepare, set_learning_rate

__all__ = ["SACConfig", "SACLearner", "train_sac"]

LOGGED = ("loss_actor", "loss_qvalue", "loss_alpha", "alpha", "entropy")
"""What is written down of each gradient step."""


@single_threaded()
def train_sac(config: TrainingConfig, folder: Path | None = None) -> TrainingSummary:
    """Trains a policy and writes the results to the run's folder; see :class:`TrainingRun`.

    Args:
        config: settings of the training.
        folder: folder of a run to continue; ``None`` begins a new one.

    Raises:
        ValueError: for an unknown world, or a setting out of range.
        FileExistsError: if there is a run of that name.
    """
    config = prepare(config)
    learner = SACLearner(config)
    with TrainingRun(config, learner, folder) as run:
        for batch in run.batches():
            learner.remember(batch)
            run.record(learner.update(run.share, run.stopwatch))
    return run.summary


class SACLearner:
    """Actor, two action critics with slow copies, a replay buffer, and how they learn from it."""

    def __init__(self, config: TrainingConfig) -> None:
        assert isinstance(config.algorithm, SACConfig)
        self.config, self._settings = config, config.algorithm
        settings, network, device = config.algorithm, config.network, config.device
        self._encoder = ObservationEncoder(network.observation, config.env.lidar.points, network.north_up)
        spec = action_spec(config.env.action, device)
        self.actor = make_actor(self._encoder, network.hidden, config.env.action, network.max_std, device)
        self._loss = SACLoss(
            on_features(self.actor),
            make_action_critic(self._encoder.features, network.hidden, config.env.action, device),
            num_qvalue_nets=2,
            loss_function="l2",
            action_spec=spec,
            alpha_init=settings.alpha,
            # TorchRL's entropy is that of actions in their own units, whose range is wider by this factor.
            target_entropy=settings.target_entropy + math.log(middle_and_half(spec)[1].prod().item()),
        ).to(device)
        self._loss.make_value_estimator(gamma=settings.gamma)
        self._slow_copies = SoftUpdate(self._loss, tau=settings.tau)
        self._optimizer = torch.optim.Adam(self._loss.parameters(), lr=settings.learning_rate, fused=True)
        storage = LazyTensorStorage(settings.buffer_size, device=device)
        self._memory = ReplayBuffer(storage=storage, batch_size=settings.minibatch)
        self._due = 0.0
        after = ("reward", "done", "terminated", *network.observation)
        self._learned_from = (*network.observation, "action", *(("next", key) for key in after))

    def remember(self, batch: TensorDictBase) -> None:
        """Adds decisions ``[N, T]``, as a collector gives them, to the replay buffer."""
        decisions = batch.select(*self._learned_from).reshape(-1)
        decisions["next", "reward"] = decisions["next", "reward"] * self._settings.reward_scale
        self._memory.extend(decisions)
        if len(self._memory) >= self._settings.learning_starts:
            self._due += self._settings.gradient_steps * len(batch) / self.config.num_envs

    def update(self, share: float, stopwatch: Stopwatch) -> dict[str, float]:
        """Takes gradient steps on remembered decisions; returns means over them, nan as long as it waits for more.

        Args:
            share: of the training that is done.
            stopwatch: takes the time of the gradient steps.
        """
        learning_rate = set_learning_rate(self._optimizer, self.config, share)
        count, self._due = int(self._due), self._due % 1
        with stopwatch("gradient steps"):
            steps = [self._gradient_step(self._memory.sample()) for _ in range(count)]
            # Waits for those that a GPU is still at.
            means = torch.stack(steps).mean(0).tolist() if steps else [math.nan] * len(LOGGED)
        return {"gradient_steps": count, "learning_rate": learning_rate, **dict(zip(LOGGED, means, strict=True))}

    def _gradient_step(self, decisions: TensorDictBase) -> Tensor:
        if self._settings.mirror_augmentation:
            decisions = mirrored(decisions, torch.rand(len(decisions), device=self.config.device) < 0.5)
        # Once, for all networks that see them.
        for seen in (decisions, decisions["next"]):
            seen["features"] = self._encoder(*(seen[key] for key in self._encoder.keys))
        losses = self._loss(decisions)
        self._optimizer.zero_grad()
        (losses["loss_actor"] + losses["loss_qvalue"] + losses["loss_alpha"]).backward()
        self._optimizer.step()
        self._slow_copies.step()
        return torch.stack([losses[key].detach() for key in LOGGED])

    def weights(self) -> dict[str, Tensor]:
        """Those of all networks, by name."""
        return dict(self._loss.named_parameters())

    def state_dict(self) -> dict[str, Any]:
        """Weights, the optimizer's moments, the replay buffer, and what part of a gradient step is due."""
        storage, count = self._memory.storage, len(self._memory)
        return {
            "loss": self._loss.state_dict(),
            "optimizer": self._optimizer.state_dict(),
            # A copy, for a slice would be saved with all of the storage behind it.
            "memory": storage[:count].clone().flatten_keys("/").to_dict() if count else {},
            "cursor": self._memory.writer._cursor,
            "due": self._due,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Goes on from what :meth:`state_dict` gave."""
        self._loss.load_state_dict(state["loss"])
        self._optimizer.load_state_dict(state["optimizer"])
        if state["memory"]:
            count = len(state["memory"]["action"])
            self._memory.extend(TensorDict(state["memory"], batch_size=[count]).unflatten_keys("/"))
        self._memory.writer._cursor = state["cursor"]
        self._due = state["due"]
