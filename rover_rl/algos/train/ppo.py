"""PPO with TorchRL: collect decisions of a batch of rovers, estimate advantages, take gradient steps.

:func:`rover_rl.algos.train.train` is the training loop and :class:`PPOLearner` the update.
:mod:`rover_rl.algos.train.collectors` collects the batches, :mod:`rover_rl.algos.policy.networks` has the networks, and
:mod:`rover_rl.algos.train.run` handles the run's folder, log, checkpoints and Ctrl-C.

The loop is explicit instead of using TorchRL 0.14's experimental ``PPOTrainer``. With hooks for reward scale, one GAE
per batch, annealing, mirror augmentation, imitation, log and time limit, ``PPOTrainer`` trains equally well and fast
(inspect, one seed, 123,000 steps: 64 of 64 stored episodes reach the goal with both). Its drawbacks: without an
additional handler, Ctrl-C and SIGTERM end it without a checkpoint; by default, its files lack the state of PyTorch's
random generator; with a fixed number of gradient steps per epoch it skips every second epoch; and the losses that it
logs are means over the last epoch only.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.modules import set_recurrent_mode
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

from rover_rl.algos.config import PPOConfig, TrainingConfig
from rover_rl.algos.policy.expert import PrivilegedExpert
from rover_rl.algos.policy.grid_planner import follow
from rover_rl.algos.policy.networks import (
    ObservationEncoder,
    action_spec,
    make_actor,
    make_critic,
    middle_and_half,
    mirrored,
)
from rover_rl.algos.train.progress import Stopwatch
from rover_rl.algos.train.run import Learner
from rover_rl.algos.train.sequences import MirrorMemory, mirrored_sequences
from rover_rl.envs.sensors.suite import ROUTE
from rover_rl.sims.robots import get_robot
from rover_rl.sims.worlds.pool import WorldPool

__all__ = ["PPOConfig", "PPOLearner"]

LOGGED = ("loss_objective", "loss_critic", "entropy", "kl_approx", "clip_fraction")
"""Values that are logged for each gradient step."""


class PPOLearner(Learner):
    """Actor, critic and their PPO update."""

    def __init__(self, config: TrainingConfig) -> None:
        assert isinstance(config.algorithm, PPOConfig)
        self.config, self._settings = config, config.algorithm
        settings, network, device = config.algorithm, config.network, config.device
        encoder = ObservationEncoder(
            network.observation, config.env.lidar.points, network.north_up, config.env.own_sensors
        )
        self.actor = make_actor(
            encoder,
            network.hidden,
            config.env.action,
            network.max_std,
            device,
            memory=network.memory,
            memory_size=network.memory_size,
            follower=None if network.prior == "none" else get_robot(config.env.robot),
        )
        self.critic = make_critic(encoder, network.hidden, device, network.privileged_critic)
        self._sensors = encoder.sensors
        self._advantage = GAE(gamma=settings.gamma, lmbda=settings.lmbda, value_network=self.critic, average_gae=True)
        self._loss = ClipPPOLoss(
            self.actor,
            self.critic,
            clip_epsilon=settings.clip,
            entropy_coeff=settings.entropy_coef,
            critic_coeff=0.5,
            loss_critic_type="l2",
        )
        self._optimizer = torch.optim.Adam(self._loss.parameters(), lr=settings.learning_rate)
        self._expert = _make_expert(config) if settings.imitation else None
        self._recurrent, self._mirror_memory = network.memory != "none", MirrorMemory(self.actor, encoder.sensors)
        inputs = dict.fromkeys((*self.actor.in_keys, *self.critic.in_keys))
        self._training_keys = (*inputs, "action", "action_log_prob", "advantage", "value_target")

    def update(self, batch: TensorDictBase, share: float, stopwatch: Stopwatch) -> dict[str, float]:
        """Updates the networks with a batch and returns the means of the logged values over the gradient steps."""
        learning_rate = self._set_learning_rate(share)
        batch["next", "reward"] *= self._settings.reward_scale
        with torch.no_grad():
            self._advantage(batch)
        decisions = batch.select(*self._training_keys)
        gradient_step = self._gradient_step
        if self._expert and share < self._settings.imitation:
            # DAgger (Ross et al., 2011): the policy drives, and the expert labels the visited states with its actions.
            decisions["action"] = self._inside_bounds(self._expert(batch))
            gradient_step = self._imitation_step
        elif share < self._settings.critic_warmup:
            gradient_step = self._critic_step
        steps = []
        for part in self._minibatches(decisions):
            with stopwatch("gradient steps"):
                steps.append(gradient_step(part))
        with stopwatch("gradient steps"):
            # Includes the time until the GPU has finished.
            means = torch.stack(steps).mean(0).tolist()
        return {"gradient_steps": len(steps), "learning_rate": learning_rate, **dict(zip(LOGGED, means, strict=True))}

    def _minibatches(self, decisions: TensorDictBase) -> Iterator[TensorDictBase]:
        """Yields the minibatches of all epochs, some of their decisions mirrored.

        A minibatch has decisions ``[M]``, or with a memory whole sequences of some rovers ``[M, T]``.
        """
        settings, device, size = self._settings, self.config.device, self._settings.minibatch
        starts = self._mirror_memory.starts(decisions) if settings.mirror_augmentation else {}
        if self._recurrent:
            size = max(1, size // settings.rollout_length)
        else:
            decisions = decisions.reshape(-1)
        for _ in range(settings.epochs):
            order = torch.randperm(len(decisions), device=device)
            shuffled = decisions[order]
            if settings.mirror_augmentation:
                rows = torch.rand(len(shuffled), device=device) < 0.5
                if self._recurrent:
                    states = {key: state[order] for key, state in starts.items()}
                    shuffled = mirrored_sequences(shuffled, rows, states, self._sensors)
                else:
                    shuffled = mirrored(shuffled, rows, self._sensors)
            yield from shuffled.split(size)

    def _gradient_step(self, decisions: TensorDictBase) -> Tensor:
        """Takes a PPO gradient step and returns the logged values. Losses of TorchRL run memories on sequences."""
        losses = self._loss(decisions)
        self._optimizer_step(losses["loss_objective"] + losses["loss_critic"] + losses["loss_entropy"])
        return torch.stack([losses[key].detach() for key in LOGGED])

    def _imitation_step(self, decisions: TensorDictBase) -> Tensor:
        """Takes an imitation gradient step: ``loss_objective`` is the negative log-likelihood of ``action``."""
        losses = self._loss(decisions)
        with set_recurrent_mode(True):
            losses["loss_objective"] = -self.actor.get_dist(decisions).log_prob(decisions["action"]).mean()
        self._optimizer_step(losses["loss_objective"] + losses["loss_critic"])
        return torch.stack([losses[key].detach() for key in LOGGED])

    def _critic_step(self, decisions: TensorDictBase) -> Tensor:
        """Takes a gradient step of the critic alone."""
        losses = self._loss(decisions)
        self._optimizer_step(losses["loss_critic"])
        return torch.stack([losses[key].detach() for key in LOGGED])

    def _inside_bounds(self, action: Tensor) -> Tensor:
        """Clips actions and scales them to 95 % of their range: a squashed normal does not reach its bounds."""
        middle, half = middle_and_half(action_spec(self.config.env.action, self.config.device))
        return middle + 0.95 * torch.minimum(torch.maximum(action - middle, -half), half)

    def _optimizer_step(self, loss: Tensor) -> None:
        self._optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self._loss.parameters(), self._settings.max_grad_norm)
        self._optimizer.step()


def _make_expert(config: TrainingConfig) -> Callable[[TensorDictBase], Tensor]:
    """Returns the expert to imitate, a function from decisions ``[...]`` to actions ``[..., 2]``."""
    assert isinstance(config.algorithm, PPOConfig)
    robot = get_robot(config.env.robot)
    if config.algorithm.expert == "route":
        return lambda decisions: follow(decisions["lidar"], decisions["imu"], decisions[ROUTE], robot)
    return PrivilegedExpert(WorldPool.of(config.env.world), robot, config.device).action
