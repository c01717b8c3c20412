"""SAC with TorchRL: collect decisions of a batch of rovers into a replay buffer, take gradient steps on samples of it.

With several workers, collection continues during the gradient steps, with a policy that is one batch old. SAC is
off-policy and learns from data of older policies. The loop is explicit instead of TorchRL 0.14's ``SACTrainer``, whose
file lacks the replay buffer.
"""

from __future__ import annotations

import math
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import LazyTensorStorage, ReplayBuffer
from torchrl.objectives import SACLoss, SoftUpdate

from rover_rl.algos.config import SACConfig, TrainingConfig
from rover_rl.algos.policy import networks
from rover_rl.algos.train.progress import Stopwatch
from rover_rl.algos.train.run import Learner

__all__ = ["SACConfig", "SACLearner"]


class SACLearner(Learner):
    """Actor, two critics with target networks, a replay buffer and the SAC update."""

    logged = ("loss_actor", "loss_qvalue", "loss_alpha", "alpha", "entropy")
    _loss: SACLoss

    def __init__(self, config: TrainingConfig) -> None:
        assert isinstance(config.algorithm, SACConfig)
        self.config, self._settings = config, config.algorithm
        settings, network, device = config.algorithm, config.network, config.device
        self._encoder = networks.encoder_of(config)
        self._mirrors = networks.mirrors_of(self._encoder.sensors, config.env.action.kind)
        spec = networks.action_spec(config.env.bounded_action, device)
        self.actor = networks.actor_of(config, self._encoder, device)
        self._loss = SACLoss(
            networks.on_features(self.actor),
            networks.make_action_critic(self._encoder, network.hidden, config.env.bounded_action, device),
            num_qvalue_nets=2,
            loss_function="l2",
            action_spec=spec,
            alpha_init=settings.alpha,
            # TorchRL computes the entropy of unscaled actions, whose range is larger than [-1, 1] by this factor.
            target_entropy=settings.target_entropy + math.log(networks.middle_and_half(spec)[1].prod().item()),
        ).to(device)
        self._loss.make_value_estimator(gamma=settings.gamma)
        self._target_update = SoftUpdate(self._loss, tau=settings.tau)
        self._optimizer = torch.optim.Adam(self._loss.parameters(), lr=settings.learning_rate, fused=True)
        storage = LazyTensorStorage(settings.buffer_size, device=device)
        self._replay_buffer = ReplayBuffer(storage=storage, batch_size=settings.minibatch)
        self._gradient_steps_due = 0.0
        next_keys = ("reward", "done", "terminated", *network.observation)
        self._training_keys = (*network.observation, "action", *(("next", key) for key in next_keys))

    def update(self, batch: TensorDictBase, share: float, stopwatch: Stopwatch) -> dict[str, float]:
        decisions = batch.select(*self._training_keys).reshape(-1)
        decisions["next", "reward"] = decisions["next", "reward"] * self._settings.reward_scale
        self._replay_buffer.extend(decisions)
        if len(self._replay_buffer) >= self._settings.learning_starts:
            self._gradient_steps_due += self._settings.gradient_steps * len(batch) / self.config.num_envs
        count, self._gradient_steps_due = int(self._gradient_steps_due), self._gradient_steps_due % 1
        with stopwatch("gradient steps"):
            critic_alone = share < self._settings.critic_warmup
            return self._means([self._gradient_step(self._replay_buffer.sample(), critic_alone) for _ in range(count)])

    def _gradient_step(self, decisions: TensorDictBase, critic_alone: bool) -> Tensor:
        if self._settings.mirror_augmentation:
            rows = torch.rand(len(decisions), device=self.config.device) < 0.5
            decisions = networks.mirrored(decisions, rows, self._mirrors)
        # Encodes the observations once for all networks.
        for observation in (decisions, decisions["next"]):
            observation["features"] = self._encoder(*(observation[key] for key in self._encoder.keys))
        losses = self._loss(decisions)
        self._optimizer.zero_grad()
        rest = 0.0 if critic_alone else losses["loss_actor"] + losses["loss_alpha"]
        (losses["loss_qvalue"] + rest).backward()
        self._optimizer.step()
        self._target_update.step()
        return torch.stack([losses[key].detach() for key in self.logged])

    def state_dict(self) -> dict[str, Any]:
        storage, count = self._replay_buffer.storage, len(self._replay_buffer)
        return {
            **super().state_dict(),
            # Cloned: a slice would be saved with the whole storage.
            "memory": storage[:count].clone().flatten_keys("/").to_dict() if count else {},
            "cursor": self._replay_buffer.writer.state_dict()["_cursor"],
            "due": self._gradient_steps_due,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        super().load_state_dict(state)
        if state["memory"]:
            count = len(state["memory"]["action"])
            self._replay_buffer.extend(TensorDict(state["memory"], batch_size=[count]).unflatten_keys("/"))
        # After extend, which moves the cursor.
        self._replay_buffer.writer.load_state_dict({"_cursor": state["cursor"]})
        self._gradient_steps_due = state["due"]
